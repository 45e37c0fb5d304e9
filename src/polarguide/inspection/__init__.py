"""Inspection: verdicts on a capture; order, sense and zero of the polarizer angles by geometry."""

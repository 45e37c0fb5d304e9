"""Inspection of a capture: checks of its pictures and poses, and of the order, sense and zero of its angles."""

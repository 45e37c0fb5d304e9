"""Polarizer angles: fits to pictures, searches for unknown angles, and checks of known angles."""

"""Angles of polarizers: fitted to pictures, sought in short trainings where they are unknown, and judged."""

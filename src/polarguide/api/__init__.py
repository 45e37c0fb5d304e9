"""The Python interface, as ``import polarguide`` offers it: captures, and runs."""

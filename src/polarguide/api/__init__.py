"""The Python interface, as ``import polarguide`` gives it: captures, and runs."""

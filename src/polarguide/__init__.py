"""polarguide: polarization photographs to a Gaussian splatting scene with its reflections separated."""

__version__ = "0.1.0"

"""Which Gaussians are metals, found from what all views measured of them and from what the user says."""

"""What a trained run shows: pictures, films, other light, and polarization priors."""

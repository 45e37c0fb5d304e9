"""Pictures of a trained run: layers, films, other light, and polarization priors."""

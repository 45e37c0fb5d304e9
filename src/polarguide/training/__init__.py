"""Training: recipes as data, losses, polarization priors, the loop over one scene."""

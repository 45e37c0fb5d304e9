"""Search for metals among the Gaussians, based on the measurements of all views and on labels of the user."""

"""A rotating polarizing filter in front of an ordinary camera: four shots per view."""

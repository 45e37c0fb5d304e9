"""Prepare a scene folder from camera files (``polarguide prepare``)."""

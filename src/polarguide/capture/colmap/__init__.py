"""COLMAP models: the only room that knows pycolmap."""

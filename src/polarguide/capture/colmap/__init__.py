"""COLMAP models and COLMAP itself: the only package that imports pycolmap."""

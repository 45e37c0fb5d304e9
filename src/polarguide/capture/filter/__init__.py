"""Read and develop shots of an ordinary camera with a rotating polarizing filter in front of the lens."""

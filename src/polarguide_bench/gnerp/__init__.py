"""GNeRP (Li et al. 2024) in PyTorch: a neural signed-distance field that is trained with polarization."""

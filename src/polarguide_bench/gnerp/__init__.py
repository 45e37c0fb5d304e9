"""Neural fields in plain torch: GNeRP (Li et al. 2024), a signed-distance field trained with polarization."""

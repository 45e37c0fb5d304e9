"""Export of trained scenes to file formats of other programs."""

"""Results of a run: pictures, scores and files for other programs."""

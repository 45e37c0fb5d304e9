"""Camera files -> a scene folder: what ``polarguide prepare`` does."""

"""Decoders of picture and array files, with strict checks and limits on size."""

"""Decode files of pictures and arrays, with strict checks and limits on size."""

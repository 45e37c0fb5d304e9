"""Files of pictures and arrays: strict decoding with limits on size."""

"""Eye finder, which locates eyes in pictures, and tracker, which predicts eye positions in `stack`."""

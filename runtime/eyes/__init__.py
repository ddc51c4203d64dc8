"""Eye finder, which locates eyes in pictures, and tracker, which predicts their positions in `stack`."""

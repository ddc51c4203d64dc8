"""Eye finder, which locates eyes in pictures, and tracker, which predicts them in frame `stack`."""

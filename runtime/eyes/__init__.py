"""Finds both eyes in pictures or samples, transforms them to the `stack` frame, and tracks and predicts them."""

"""Finding both eyes in pictures or samples, and tracking and predicting them in the `stack` frame."""

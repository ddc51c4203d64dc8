"""Finding both eyes in pictures, and tracking and predicting them in the `stack` frame."""

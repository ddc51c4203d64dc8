"""Two eyes in the `stack` frame: from pictures or samples, calibrated, tracked and predicted."""

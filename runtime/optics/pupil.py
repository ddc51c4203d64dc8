"""Default pupil diameter and tracking error (docs/mathematics.md, Light)."""

PUPIL_MM = 4.0  # diameter
TRACKING_SIGMA_MM = 1.0  # standard deviation, along each axis, of a good tracker's error, which both eyes share

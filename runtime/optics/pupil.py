"""Default pupil diameter and tracking error of an eye (docs/mathematics.md, Light)."""

PUPIL_MM = 4.0  # diameter
TRACKING_SIGMA_MM = 1.0  # standard deviation of the eyes' common position along each axis, with a good tracker

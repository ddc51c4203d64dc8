"""Default pupil diameter and tracking error of an eye (docs/mathematics.md, Light)."""

PUPIL_MM = 4.0  # diameter
TRACKING_SIGMA_MM = 1.0  # a good tracker's: standard deviation of the eyes' common position along an axis

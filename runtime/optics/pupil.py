"""An eye's width, and how surely its place is known: neither is the other (docs/mathematics.md, Light)."""

PUPIL_MM = 4.0  # diameter
TRACKING_SIGMA_MM = 1.0  # of a good tracker: standard deviation of the eyes' common place along an axis

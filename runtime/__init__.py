"""phasestack: the realtime runtime of a glasses-free 3D display made of stacked LCD panels."""

__version__ = "0.1.0"

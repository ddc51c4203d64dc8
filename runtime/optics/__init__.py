"""The display's optics: pure functions of arrays. Frames, units and equation numbers are in each docstring."""

"""The display's optics: pure functions of arrays, with frames, units and equation numbers."""

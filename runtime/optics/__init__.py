"""Optics of the display: pure functions of arrays, with frames, units and equation numbers."""

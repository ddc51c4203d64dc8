"""Calibration: the sensor's place before the stack, the panels' registration, and their grey curves."""

"""Calibration of the sensor's pose, the panels' registration and their grey curves."""

"""Calibration of the sensor's pose, the registration of the panels and their grey curves."""

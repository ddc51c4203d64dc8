"""Calibration of a display: the pose of the sensor, the registration of the panels and their grey curves."""

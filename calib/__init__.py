"""Calibration: pose of the sensor, registration of the panels, and their grey curves."""

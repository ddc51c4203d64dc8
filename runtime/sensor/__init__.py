"""Depth-camera and eye-tracker drivers, recordings, and the thread that polls a driver."""

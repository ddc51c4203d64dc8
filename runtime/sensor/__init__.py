"""Drivers for depth cameras and eye trackers, recordings, and the thread that polls the driver."""

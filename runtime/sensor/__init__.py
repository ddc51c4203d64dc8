"""Drivers for depth cameras and eye trackers, recordings, and the thread that reads a driver."""

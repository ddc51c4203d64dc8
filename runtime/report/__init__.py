"""Measurements of quality against run time, in motion and of stability, with their pages and plots."""

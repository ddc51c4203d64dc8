"""Measurements of quality against run time, of moving viewers and of stability, with pages and plots."""

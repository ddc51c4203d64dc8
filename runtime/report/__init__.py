"""Measure quality against run time, quality for moving viewers, and stability; write pages and plots."""

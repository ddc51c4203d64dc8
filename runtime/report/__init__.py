"""Measurements of error against run time, of stability and in motion; their pages and plots."""

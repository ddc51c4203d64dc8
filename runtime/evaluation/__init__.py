"""Evaluate runs and solutions: displayed quality, output files and the contact sheet.

Arguments are named as in `runtime.optics`. `sigmas_mm` are the tracking errors to assume.
"""

"""Evaluate runs and solutions: displayed quality, output files and the contact sheet."""

"""Outputs to the panels (offscreen, windows, browser), the presentation shader, and monitor queries."""

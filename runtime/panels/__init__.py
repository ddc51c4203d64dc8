"""Outputs for the panels' pictures (offscreen, windows, browser), the presentation shader, and monitors."""

"""Outputs for panel pictures (offscreen, windows, browser), the presentation shader, and monitors."""

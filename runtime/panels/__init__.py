"""Outputs for panel values (offscreen, windows, browser), the presentation shader, and monitors."""

"""Sinks for panel values (offscreen, windows), the presentation shader, and monitors."""

"""Sinks of panel values: offscreen and windows, the presentation shader, monitors."""

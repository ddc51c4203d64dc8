"""Outputs to the panels (offscreen, windows, browser), the presentation shader, and monitor queries.

Sequences of panels, monitors, mounts and windows run from rear to front. `screen_px` and `layer_px` are the width and
height of a monitor and of each of the stack's panels.
"""

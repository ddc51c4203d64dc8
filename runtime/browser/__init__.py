"""Scripts that make a web browser the viewer and the display, and pages that show one solution."""

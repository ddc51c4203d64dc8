"""Scripts that turn a web browser into the viewer and the display, and pages that show one solution."""

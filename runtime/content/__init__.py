"""Content sources, each of which draws a scene as one eye sees it, on a given grid of pixels."""

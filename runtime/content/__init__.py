"""Content sources, which draw the picture of a scene for one eye in a given raster."""

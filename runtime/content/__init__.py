"""Content sources: the picture of a scene for one eye, in a given raster."""

"""Content sources. Each draws a scene as seen by one eye, on a given pixel grid."""

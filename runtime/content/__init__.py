"""Sources of pictures: each draws what an eye should see into a raster that is asked for."""

"""What surrounds the network, by fragment shaders of OpenGL 3.3 core."""

"""The solver's operations as fragment shaders of OpenGL 3.3 core."""

"""Solver operations, implemented as fragment shaders for the OpenGL 3.3 core profile."""

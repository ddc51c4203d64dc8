"""Operations of the solver as fragment shaders of OpenGL 3.3 core."""

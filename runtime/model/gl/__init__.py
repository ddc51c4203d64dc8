"""Operations of the solver, implemented as fragment shaders for the core profile of OpenGL 3.3."""

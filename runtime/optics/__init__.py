"""Display optics, implemented as pure functions of arrays.

Names and docstrings state the frame and unit of each quantity, and the equation that a function implements.
"""

"""Optics of the display as pure functions of arrays.

Names and docstrings state frames, units and equations.
"""

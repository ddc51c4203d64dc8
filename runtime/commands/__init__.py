"""The command line, with one module for each command. Heavy imports are inside the functions."""

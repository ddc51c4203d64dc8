"""One module for each command: arguments at the top, heavy imports inside the functions."""

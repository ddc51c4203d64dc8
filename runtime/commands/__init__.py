"""The command line: one module per command. Heavy imports are inside the functions."""

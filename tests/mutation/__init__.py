"""Mutants of the code, and whether a test notices them."""

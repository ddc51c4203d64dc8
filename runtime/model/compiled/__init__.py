"""Compiled inner loops of what surrounds the network on the processor (numba)."""

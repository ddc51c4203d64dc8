"""Simulator of a stack of real panels. It is used to judge layers, never to compute them."""

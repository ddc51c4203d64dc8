"""Shared utilities: atomic output, untrusted input, background jobs, OpenGL contexts, logs."""

"""Shared utilities: atomic files, untrusted input, background jobs, GL contexts, logs."""

"""Record a run for debugging: the last minutes in memory, and a journal on disk."""

"""Record of a run for debugging: the last minutes in memory, or a journal on disk."""

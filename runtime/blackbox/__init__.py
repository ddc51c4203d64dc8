"""Record a run for debugging, keeping the last few minutes in memory and a journal on disk."""

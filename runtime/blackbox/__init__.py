"""Record a run for debugging, keeping the last few minutes in memory."""

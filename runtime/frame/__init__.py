"""One frame: solver, presenter, pacing, policy, timing, states and statistics."""

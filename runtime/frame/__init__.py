"""Everything that happens in one frame: solver, presenter, pacing, policy, states and statistics."""

"""The display loop, with presenter, solver, pacing, policy, states and statistics."""

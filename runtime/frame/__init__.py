"""The display loop: presenter, solver, pacing, policy, states and statistics."""

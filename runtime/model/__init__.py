"""Predictors, which compute all panel values from the two eyes' target pictures."""

"""Predictors, which compute the values of all panels from the target pictures of two eyes."""

"""Predictors, which compute the values of every panel from the target pictures of two eyes."""

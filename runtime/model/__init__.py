"""Predictors: values of every panel from the target pictures of two eyes."""

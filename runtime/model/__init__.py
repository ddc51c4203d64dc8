"""Predictors: two eyes and what they should see to the values of every panel."""

"""Stiff and extreme cases of all numerical methods, checked to 50 digits or against a closed form."""

"""Stiff and extreme cases of every numerical method, checked to 50 digits or against a closed form."""

"""Stiff and extreme cases of every numerical step, checked to 50 digits or against a closed form."""

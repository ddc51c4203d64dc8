"""Stiff and extreme cases of every numerical step, against 50 digits or a closed form."""

"""Stiff and extreme cases of every numerical step, each against a reference of 50 digits or a closed form."""

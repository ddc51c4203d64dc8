"""Stiff and extreme cases of all numerical methods, compared with independent references."""

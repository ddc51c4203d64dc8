"""Stiff and extreme cases for all numerical methods, compared with independent references."""

"""Savings and their measurement; and drawing, where content, views and models meet."""

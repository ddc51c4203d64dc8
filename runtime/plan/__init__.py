"""Savings and their measurement, and the drawing of targets, where content, views and models meet."""

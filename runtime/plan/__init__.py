"""What may be left out: savings and their measurement; and drawing, where content, views and models meet."""

"""The browser as a viewer's eyes and a display's light: its script, and a solution as one page."""

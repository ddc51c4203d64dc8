"""The browser as eyes and panels."""

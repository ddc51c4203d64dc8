"""The browser as viewer and display: its scripts, and pages that show one solution."""

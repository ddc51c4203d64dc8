"""The browser as viewer and display: scripts, and pages that show one solution."""

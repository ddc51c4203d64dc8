"""A module for each command: arguments on top, everything heavy imported inside."""

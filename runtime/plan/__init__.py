"""Plan which work to skip, measure what that saves, and draw the targets of a solution."""

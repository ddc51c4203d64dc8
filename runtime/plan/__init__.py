"""Plan which work to skip, measure the savings, and draw the target pictures of a solution."""

"""Plan which work to skip, measure the savings, and draw target pictures for solutions."""

"""Golden runs, which compare recorded runs of the production code with stored references."""

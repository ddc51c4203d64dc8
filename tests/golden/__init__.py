"""Golden runs: recordings through the production path, compared field by field with stored references."""

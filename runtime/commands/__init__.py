"""The command line: one module per command, with heavy imports inside the functions so that `--help` is fast."""

"""The operator's page: a process of its own that asks the running daemon by its socket."""

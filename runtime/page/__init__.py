"""The operator's page, a separate process that talks to the running daemon over its socket."""

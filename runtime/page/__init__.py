"""The operator's page, served by a separate process that controls the daemon over a socket."""

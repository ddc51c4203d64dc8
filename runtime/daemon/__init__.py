"""The daemon: building, supervising and reconfiguring a run; its socket, signals and notifications."""

"""The daemon: building, supervising and reconfiguring a run; socket, signals, notifications."""

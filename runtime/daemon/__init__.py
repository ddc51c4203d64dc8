"""What makes a run a daemon: building, supervising, reconfiguring, metrics, the socket, signals, notifications."""

"""What makes a run a daemon: building, supervising, reconfiguring, the socket, signals, notifications."""

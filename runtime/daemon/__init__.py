"""Daemon: builds, supervises and reconfigures a run; socket, signals, notifications."""

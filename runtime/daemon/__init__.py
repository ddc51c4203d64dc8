"""The daemon, which builds, supervises and reconfigures a run and answers on a local socket."""

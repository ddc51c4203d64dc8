"""The daemon: builds, supervises and reconfigures a run, and answers requests on a local socket."""

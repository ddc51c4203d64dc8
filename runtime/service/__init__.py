"""What makes the loop a daemon: the supervisor's notifications, signals, and the status and control socket."""

from runtime.service.commands import Command
from runtime.service.notify import Notifier
from runtime.service.server import StatusServer, open_status_server
from runtime.service.signals import Signals

__all__ = ["Command", "Notifier", "Signals", "StatusServer", "open_status_server"]

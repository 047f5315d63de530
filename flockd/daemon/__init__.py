"""The daemon on the drone: owns time, devices, threads and failure around the pure line."""

from flockd.daemon.daemon import Daemon, DaemonError, Ending
from flockd.daemon.lock import only_instance
from flockd.daemon.service import ServiceManager

__all__ = ["Daemon", "DaemonError", "Ending", "ServiceManager", "only_instance"]

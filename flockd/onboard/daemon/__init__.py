"""The daemon on the drone: owns time, devices, threads and failure around the pure line."""

from flockd.onboard.daemon.daemon import Daemon, DaemonError
from flockd.onboard.daemon.message_sinks import StderrLog
from flockd.onboard.daemon.status import Components, ServiceManager
from flockd.onboard.daemon.watched_networks import InterruptibleNetworks, cameras_at_once, load_side_by_side

__all__ = [
    "Components",
    "Daemon",
    "DaemonError",
    "InterruptibleNetworks",
    "ServiceManager",
    "StderrLog",
    "cameras_at_once",
    "load_side_by_side",
]

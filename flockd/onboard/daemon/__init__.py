"""The daemon on the drone: owns time, devices, threads and failure around the pure line."""

from flockd.onboard.daemon.components import Components
from flockd.onboard.daemon.daemon import Daemon, DaemonError
from flockd.onboard.daemon.service_manager import ServiceManager
from flockd.onboard.daemon.simulated_loop import event_loop_at
from flockd.onboard.daemon.stderr_log import StderrLog
from flockd.onboard.daemon.watched_networks import InterruptibleNetworks, cameras_at_once, load_side_by_side
from flockd.onboard.sources import clock_at

__all__ = [
    "Components",
    "Daemon",
    "DaemonError",
    "InterruptibleNetworks",
    "ServiceManager",
    "StderrLog",
    "cameras_at_once",
    "clock_at",
    "event_loop_at",
    "load_side_by_side",
]

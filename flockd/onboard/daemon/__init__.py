"""The daemon on the drone: time, devices, threads and failures around the pure pipeline."""

from flockd.onboard.daemon.daemon import Daemon, DaemonError
from flockd.onboard.daemon.message_sinks import StderrLog
from flockd.onboard.daemon.status import Components, ServiceManager
from flockd.onboard.daemon.supervisor_inputs import THERMAL_ZONES, thermal_zones
from flockd.onboard.daemon.watched_networks import cameras_at_once, load_side_by_side

__all__ = [
    "THERMAL_ZONES",
    "Components",
    "Daemon",
    "DaemonError",
    "ServiceManager",
    "StderrLog",
    "cameras_at_once",
    "load_side_by_side",
    "thermal_zones",
]

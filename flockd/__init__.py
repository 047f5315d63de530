"""flockd: drones that flock by sight alone.

The names below are what other programs may rely on; "Use it from Python" in the documentation has programs with them.
Each loads what it needs when it is first used, so that `import flockd` loads nothing.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from flockd.core.config import load_drone
    from flockd.core.messages import Frame, FrameSet, PilotOutput, VehicleState
    from flockd.flight.flocking import FlockingLaw, FlockingParameters
    from flockd.flight.geometry import PinholeCamera, RigidTransform, build_rig, fit_rigid, ransac_rigid
    from flockd.flight.perception import Perception, load_networks
    from flockd.flight.pilot import FlockPilot
    from flockd.flight.pilot.ground import level_ground
    from flockd.flight.safety import Gate
    from flockd.flight.tracking import Measurement, Tracker, TrackingParameters
    from flockd.ground.pictures.single_frame import PictureDetector
    from flockd.onboard.recording import Recording

__version__ = "0.2.0"

__all__ = [
    "FlockPilot",
    "FlockingLaw",
    "FlockingParameters",
    "Frame",
    "FrameSet",
    "Gate",
    "Measurement",
    "Perception",
    "PictureDetector",
    "PilotOutput",
    "PinholeCamera",
    "Recording",
    "RigidTransform",
    "Tracker",
    "TrackingParameters",
    "VehicleState",
    "build_rig",
    "fit_rigid",
    "level_ground",
    "load_drone",
    "load_networks",
    "ransac_rigid",
]

_HOMES = {
    "flockd.core.config": ("load_drone",),
    "flockd.core.messages": ("Frame", "FrameSet", "PilotOutput", "VehicleState"),
    "flockd.flight.flocking": ("FlockingLaw", "FlockingParameters"),
    "flockd.flight.geometry": ("PinholeCamera", "RigidTransform", "build_rig", "fit_rigid", "ransac_rigid"),
    "flockd.flight.perception": ("Perception", "load_networks"),
    "flockd.flight.pilot": ("FlockPilot",),
    "flockd.flight.pilot.ground": ("level_ground",),
    "flockd.flight.safety": ("Gate",),
    "flockd.flight.tracking": ("Measurement", "Tracker", "TrackingParameters"),
    "flockd.ground.pictures.single_frame": ("PictureDetector",),
    "flockd.onboard.recording": ("Recording",),
}
"""Where each name is defined: the imports above, for when the program runs."""


def __getattr__(name: str) -> object:
    for module, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(module), name)
            return value
    raise AttributeError(f"module 'flockd' has no attribute {name!r}", name=name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def program() -> NoReturn:
    """The installed `flockd`. Ctrl-C while it is still being imported ends it without a traceback too.

    NumPy's linear algebra gets one thread, unless the environment says otherwise: more threads wait for each other on
    processors that cameras and networks need, and small matrices take ten times as long.
    """
    for library in ("OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    try:
        import_module("flockd.cli").program()
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
    raise SystemExit(130)

"""Maps and detections of all cameras in one frame set, with one label for each drone across the rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from flockd.core.messages import Detection, Float32Array, Reason, UInt8Array, VehicleState
from flockd.flight.geometry import RangeMap


@dataclass(frozen=True, eq=False)
class CameraObservation:
    """One camera's image and maps, all of the camera's size."""

    image: UInt8Array
    """(h, w, 3) RGB."""
    depth: RangeMap | None
    """(h, w) metres along the ray, drones at their detections' ranges; NaN where the lens images nothing.

    None: it has no scale."""
    labels: UInt8Array
    """(h, w) 0 background, k the detection with label k, 255 not to be used."""
    flow: Float32Array | None
    """(h, w, 2) pixels from the image before to this one; None: there is no image before, or the flow failed."""


@dataclass(frozen=True, eq=False)
class Observation:
    """All cameras at one time."""

    time_s: float
    vehicle: VehicleState
    cameras: Mapping[str, CameraObservation]
    detections: tuple[Detection, ...]
    previous: Observation | None
    """The observation that the flow starts from; its own previous one is None. None: a new start."""
    reasons: tuple[Reason, ...] = ()
    """Why parts are missing."""
    noisy_cameras: tuple[str, ...] = ()
    """Cameras whose images were noise and were not used."""

    @property
    def flows(self) -> dict[str, Float32Array]:
        """Flow by camera, if both observations have an image."""
        return {name: camera.flow for name, camera in self.cameras.items() if camera.flow is not None}

    @property
    def interval_s(self) -> float:
        """Time since the previous observation. Raises ValueError if there is none."""
        if self.previous is None:
            raise ValueError("a single observation has no interval")
        return self.time_s - self.previous.time_s

"""What all cameras saw in one frame set, with one label a drone across the whole rig."""

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
    """(h, w, 2) pixels from the image before to this one; None where there is none before, or the flow failed."""


@dataclass(frozen=True, eq=False)
class Observation:
    """All cameras at one time."""

    time_s: float
    vehicle: VehicleState
    cameras: Mapping[str, CameraObservation]
    detections: tuple[Detection, ...]
    previous: Observation | None
    """What the flow comes from; its own previous one is None. None where the pair starts anew."""
    reasons: tuple[Reason, ...] = ()
    """Why something is missing."""
    noisy_cameras: tuple[str, ...] = ()
    """Whose images were noise, and were not used."""

    @property
    def flows(self) -> dict[str, Float32Array]:
        """By camera, where both observations have an image."""
        return {name: camera.flow for name, camera in self.cameras.items() if camera.flow is not None}

    @property
    def interval_s(self) -> float:
        """Since the previous observation. Raises ValueError where there is none."""
        if self.previous is None:
            raise ValueError("a single observation has no interval")
        return self.time_s - self.previous.time_s

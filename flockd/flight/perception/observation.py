"""Maps and detections of all cameras in one frame set, with one label for each drone across the rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flockd.core.messages import Detection, EgoMotion, Float32Array, FloatArray, Reason, UInt8Array, VehicleState
from flockd.flight.geometry import RangeMap, RigCamera, RigidTransform, inverse_ranges_of_rays


@dataclass(frozen=True, eq=False)
class CameraObservation:
    """One camera's image and maps, all of the camera's size."""

    image: UInt8Array
    """(h, w, 3) RGB."""
    depth: RangeMap | None
    """(h, w) metres along the ray; NaN where the lens images nothing. None: it has no scale."""
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

    def inverse_ranges(
        self, camera: RigCamera, start: FloatArray, ego: EgoMotion
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of background points at pixels (n, 2) of the image before: unit vectors (m, 3) to those of them that are
        background now too, in the camera's axes; inverse ranges (m,), 1/m; and baselines (m,) across the rays, m.

        By the flow of this camera, which has to be there, and the drone's own motion. NaN outside a lens's image.
        """
        now, before, lens = self.cameras[camera.name], self.previous, camera.camera
        assert before is not None
        assert now.flow is not None
        column, row = start.astype(np.int64).T
        end = start + now.flow[row, column]
        still = (lens.in_image(end) & (before.cameras[camera.name].labels[row, column] == 0)).nonzero()[0]
        start, end = start.take(still, axis=0), end.take(still, axis=0)
        column, row = end.astype(np.int64).T
        background = (now.labels[row, column] == 0).nonzero()[0]
        mount = camera.T_body_camera
        between = mount.inverse() @ RigidTransform(ego.rotation, ego.translation) @ mount
        rays = lens.rays(end.take(background, axis=0))
        return rays, *inverse_ranges_of_rays(lens.rays(start.take(background, axis=0)), rays, between)

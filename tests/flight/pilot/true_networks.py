"""The renderer's truth in the place of networks: what is left is the code's own doing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flockd.core.messages import Float32Array, FloatArray, Frame, UInt8Array
from flockd.flight.geometry import RigCamera, ZMap
from flockd.flight.perception import Crops, OneByOne, RangeEstimates, SceneMaps
from flockd.flight.perception.detection.instances import Instance
from flockd.sim.cameras.camera_simulator import CameraSimulator
from flockd.sim.renderer.renderer import Renderer, View, true_flow
from tests.flight.perception.cameras import SECOND_STAGE

_SKY_M = 1000.0
_MIN_PIXELS = 10
_SIZE_M = 0.6
"""What the true distances say of every drone's size."""


@dataclass(frozen=True, eq=False)
class _Drawn:
    """What one camera was given to see, and from where."""

    view: View
    matrix: FloatArray
    R_ned_camera: FloatArray
    position: FloatArray
    drone_rotations: FloatArray
    drone_positions: FloatArray
    shown: Sequence[int]


class TrueNetworks(OneByOne):
    """Answers for one drone with pinholes, whose images a camera simulator draws on the calling thread."""

    map_stride = 2
    second_stage = SECOND_STAGE

    def __init__(self, cameras: CameraSimulator | None) -> None:
        """None: it is never asked."""
        self._before: dict[str, _Drawn] = {}
        self._now: dict[str, _Drawn] = {}
        if cameras is not None:
            self._names = list(cameras.rig.cameras)
            self._renderer: Renderer = cameras._renderer
            cameras._renderer = self  # type: ignore[assignment]

    def render(self, matrix: FloatArray, size: tuple[int, int], R: FloatArray, place: FloatArray, **flock: Any) -> View:
        """As of the renderer, and remembered."""
        view = self._renderer.render(matrix, size, R, place, **flock)
        if len(self._now) == len(self._names):
            self._before, self._now = self._now, {}
        self._now[self._names[len(self._now)]] = _Drawn(view, matrix, R, place, **flock)
        return view

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        """The true flow."""
        a, b = self._before[second.camera], self._now[second.camera]
        return true_flow(
            a.view, b.view, b.matrix,
            R_ned_camera=(a.R_ned_camera, b.R_ned_camera), position_ned=(a.position, b.position),
            drone_rotations=(a.drone_rotations, b.drone_rotations),
            drone_positions=(a.drone_positions, b.drone_positions),
        )[0]  # fmt: skip

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        """The true depth and drones."""
        view = self._now[frame.camera].view
        depth = ZMap(np.where(np.isfinite(view.depth), view.depth, np.float32(_SKY_M)))
        return SceneMaps(depth=depth, labels=view.ids, instances=tuple(self._instances(camera)))

    def ranges(self, crops: Crops) -> RangeEstimates:
        """The true range of the drone nearest to each crop's middle."""
        found = RangeEstimates.unknown(len(crops))
        for k in range(len(crops)):
            found.log_range[k], found.centre[k], found.drone_probability[k] = self._range(crops[[k]])
        size, certain = np.full(len(crops), _SIZE_M), np.zeros(len(crops))
        return found._replace(log_range_sigma=np.full(len(crops), 0.001), size_m=size, log_size_sigma=certain)

    def _instances(self, camera: RigCamera) -> list[Instance]:
        drawn, found = self._now[camera.name], []
        for drone in drawn.shown:
            rows, columns = np.nonzero(drawn.view.ids == drone + 1)
            if rows.size < _MIN_PIXELS:
                continue
            point = drawn.R_ned_camera.T @ (drawn.drone_positions[drone] - drawn.position)
            centre = camera.camera.project(point[None])[0]
            if not np.isfinite(centre).all():
                centre = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
            box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], np.float64)
            found.append(Instance(drone + 1, centre, box, float(rows.size)))
        return sorted(found, key=lambda one: -one.area_px)

    def _range(self, crop: Crops) -> tuple[float, FloatArray, float]:
        """Log range, centre and probability of one crop."""
        size, drawn = crop.images.shape[1], next(iter(self._now.values()))
        views = [one.view for one in self._now.values()]
        visible = [d for d in drawn.shown if any((view.ids == d + 1).sum() >= _MIN_PIXELS for view in views)]
        if not visible:
            return 0.0, np.full(2, size / 2), 0.0
        (own,) = set(range(len(drawn.drone_positions))) - set(drawn.shown)
        in_body = (drawn.drone_positions[visible] - drawn.drone_positions[own]) @ drawn.drone_rotations[own]
        in_view = (in_body - crop.centres) @ crop.R_body_camera[0]
        ranges = np.linalg.norm(in_view, axis=1)
        point = in_view[np.argmax(in_view[:, 2] / ranges)]
        log_range = float(np.log(np.linalg.norm(point)))
        centre = size / 2 + crop.focal_px * point[:2] / max(point[2], 1e-3)
        inside = bool(((centre > 0) & (centre < size)).all())
        return log_range, np.clip(centre, -size, 2 * size), float(inside)

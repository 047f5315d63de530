"""A video of a flight that is being flown: the flock from above, and beside it what the first drone sees."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from flockd.core.data import written_whole
from flockd.core.messages import FloatArray, UInt8Array
from flockd.ground.pictures.copies import video_file
from flockd.onboard.telemetry.preview import LARGEST_SIDE_PX, write_at
from flockd.sim.scenario import ScenarioConfig

Picture = Callable[[str], bytes | None]
"""The newest JPEG of a camera, with detections and tracks drawn into it."""

_TRAIL_S = 20.0
_LEAST_REACH_M = 6.0
"""From the middle of the map to its edge."""
_GROUND, _LINES, _INK = (244, 245, 247), (214, 218, 224), (40, 44, 52)
_FIRST, _OTHERS = (255, 109, 0), (90, 98, 110)
"""RGB of the drone whose cameras are shown, and of the others."""


class FlightFilm:
    """Writes one image a step."""

    def __init__(self, scenario: ScenarioConfig, picture: Picture, write: Callable[[UInt8Array], None]) -> None:
        """``picture``: gives those of the first drone's cameras; ``write``: takes each image (h, w, 3) RGB."""
        cameras = scenario.drone.rig.cameras
        self._cameras, self._picture, self._write = [one.name for one in cameras], picture, write
        sizes = np.array([one.size_px for one in cameras])
        reduced = np.minimum(1.0, LARGEST_SIDE_PX / sizes.max(1, keepdims=True)) * sizes
        self._tile_px: tuple[int, int] = tuple((2 * np.ceil(reduced.max(0) / 2)).astype(int).tolist())
        """Width and height, even, as codecs need them."""
        self._trails: deque[FloatArray] = deque(maxlen=round(_TRAIL_S / scenario.drone.step_s))

    def add(self, time_s: float, position: FloatArray, removed: Collection[int] = ()) -> None:
        """Adds the image of a step, with all drones at (n, 3) m NED; ``removed`` drones are not drawn."""
        if time_s == 0.0:
            self._trails.clear()
        position = np.array(position)
        position[list(removed)] = np.nan
        self._trails.append(position[:, :2])
        seen = self._seen()
        above = seen_from_above(time_s, np.stack(self._trails), position, seen.shape[0])
        self._write(np.hstack([above, seen]))

    def _seen(self) -> UInt8Array:
        """The cameras' pictures, two beside each other, white where there is none."""
        pictures = [(camera, self._picture(camera)) for camera in self._cameras]
        width, height = self._tile_px
        canvas = np.full((math.ceil(len(pictures) / 2) * height, 2 * width, 3), 255, np.uint8)
        for number, (camera, data) in enumerate(pictures):
            bgr = None if data is None else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            if bgr is None:
                continue
            top, left = number // 2 * height, number % 2 * width
            tile = canvas[top : top + height, left : left + width]
            tile[: bgr.shape[0], : bgr.shape[1]] = bgr[..., ::-1]
            write_at(tile, (4, 0, 4, 4), f"drone 1, {camera}", (255, 255, 255))
        return canvas


def seen_from_above(time_s: float, trails: FloatArray, position: FloatArray, side_px: int) -> UInt8Array:
    """The flock from above, (side, side, 3), RGB: north is up, lines tell the scale.

    Args:
        time_s: of the flight.
        trails: (steps, n, 2) m north and east, the newest last.
        position: (n, 3), NED, m; NaN for a drone that was taken out.
        side_px: of the image.
    """
    there = np.isfinite(position[:, 0])
    low, high = (f(position[there, :2], axis=0) if there.any() else np.zeros(2) for f in (np.min, np.max))
    middle, reach = (low + high) / 2, max(_LEAST_REACH_M, 0.8 * float(np.max(high - low)))
    spacing = next(one for one in (2, 5, 10, 20, 50, 100, 1000) if one >= reach / 4)

    def pixels(ne: FloatArray) -> np.ndarray:
        right, up = ((ne - middle) / reach)[..., ::-1].transpose(-1, *range(ne.ndim - 1))
        return np.round(side_px / 2 * (1 + np.stack([right, -up], -1))).astype(np.int32)

    image = np.full((side_px, side_px, 3), _GROUND, np.uint8)
    for axis in (0, 1):
        for line in np.arange(math.ceil((middle[axis] - reach) / spacing), (middle[axis] + reach) / spacing) * spacing:
            ends = np.tile(middle, (2, 1)) + np.array([[-reach, -reach], [reach, reach]])
            ends[:, axis] = line
            cv2.polylines(image, [pixels(ends)], isClosed=False, color=_LINES)
    for drone in np.flatnonzero(there).tolist():
        trail, colour = trails[np.isfinite(trails[:, drone, 0]), drone], _OTHERS if drone else _FIRST
        cv2.polylines(image, [pixels(trail)], isClosed=False, color=colour, thickness=2, lineType=cv2.LINE_AA)
        u, v = pixels(position[drone, :2]).tolist()
        cv2.circle(image, (u, v), 7, colour, cv2.FILLED, cv2.LINE_AA)
        _write(image, (u + 9, v + 5), f"{drone + 1}")
    apart = np.linalg.norm(position[there, None] - position[None, there], axis=-1)
    closest = f", closest {np.min(apart[np.triu_indices(len(apart), 1)]):.2f} m" if there.sum() > 1 else ""
    _write(image, (8, 20), f"{time_s:.1f} s{closest}")
    _write(image, (8, side_px - 10), f"north up, lines every {spacing} m; #: of drone 1's tracks")
    return image


def _write(image: UInt8Array, at: tuple[int, int], text: str) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)


@contextmanager
def flight_film(scenario: ScenarioConfig, picture: Picture, target: Path) -> Iterator[FlightFilm]:
    """Writes a film to ``target``, which exists after the flight. Raises UsageError if it cannot be written."""
    with written_whole(target) as draft, video_file(draft, target, 1 / scenario.drone.step_s) as write:
        yield FlightFilm(scenario, picture, write)

"""Plates of a flight's key frames: what one drone's cameras saw, with detections, depth and optical flow."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm, hsv_to_rgb
from numpy.typing import NDArray

from flockd.core.messages import BoolArray, FloatArray, UInt8Array
from flockd.review.flight_log.key_frames import KeyFrame
from flockd.review.report.style import FEW, colour_of

_RIG_ORDER = ("left", "front", "right", "back")
"""Reading order of the cameras: a turn to the right. Cameras of other names follow in their own order."""
_PLATE, _INK, _MUTED = "#14181f", "#e8ecf1", "#98a3b0"
"""As dark as film under either scheme of the page, so that the images appear alike in both."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4
"""Fractional bits of the pixels that OpenCV draws at."""
_DEPTH_NORM = LogNorm(1.0, 50.0)
_DEPTH_COLOURS = colormaps["magma_r"].with_extremes(bad="#26303d")
_DEPTH_TICKS_M = (1, 2, 5, 10, 20, 50)
_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM, _GAP = 1376, 48, 125, 99, 22, 8
"""Pixels of the plate: as wide as four cameras make it, and its margins."""
_WIDEST = 512
"""Pixels across one camera's image."""
_ARROWS_ACROSS = 14
"""The flow is drawn once in each of this many cells across the image, and once for each drone."""


@dataclass(frozen=True, eq=False)
class Plate:
    """The drawing of one key frame, as the report shows it."""

    drone: str
    """Its name for people."""
    time_s: float
    width: int
    height: int
    webp: bytes


def save_plates(path: Path, frames: Sequence[KeyFrame]) -> None:
    """Draws the frames, some 0.2 MB each as WebP, a sixth of PNG, and writes them to one `.npz`."""
    index, images = [], {}
    for number, frame in enumerate(frames):
        image = filmstrip(frame)
        height, width = image.shape[:2]
        index.append({"drone": frame.title, "time_s": frame.time_s, "width": width, "height": height})
        coded = cv2.imencode(".webp", image[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 82])[1]
        images[str(number)] = np.asarray(coded, np.uint8)
    np.savez(path, allow_pickle=False, index=np.array(json.dumps(index)), **images)


def load_plates(path: Path) -> list[Plate]:
    """What `save_plates` wrote; none where there is no such file."""
    if not path.is_file():
        return []
    with np.load(path, allow_pickle=False) as file:
        index = json.loads(str(file["index"]))
        return [Plate(**of, webp=file[str(number)].tobytes()) for number, of in enumerate(index)]


def filmstrip(frame: KeyFrame) -> UInt8Array:
    """The plate (h, w, 3) RGB of a key frame: a row of images with detections, one of depth, one of flow."""
    cameras = sorted(frame.cameras, key=_rig_place)
    across = min((_WIDTH - _LEFT - _RIGHT - _GAP * (len(cameras) - 1)) // len(cameras), _WIDEST)
    down = round(across * max(image.shape[0] / image.shape[1] for image in frame.images.values()))
    key = _LEFT + len(cameras) * (across + _GAP)
    plate = np.full((_TOP + _BOTTOM + 3 * (down + _GAP) - _GAP, key + _RIGHT - _GAP, 3), _rgb(_PLATE), np.uint8)
    write(plate, _LEFT, 40, f"{frame.title}, t = {frame.time_s:.1f} s", 0.9, _INK)
    tops = [_TOP + row * (down + _GAP) for row in range(3)]
    for top, name in zip(tops, ("image", "depth", "flow"), strict=True):
        aside = np.full((_LEFT - _GAP, down, 3), _rgb(_PLATE), np.uint8)
        write(aside, (down - _width_of(name, 0.6)) / 2, 26, name, 0.6, _MUTED)
        plate[top : top + down, : _LEFT - _GAP] = np.rot90(aside)
    p95_px = _typical_flow(frame)
    for column, camera in enumerate(cameras):
        height, width = frame.images[camera].shape[:2]
        size = (across, round(across * height / width))
        labels = frame.labels.get(camera, np.zeros((height, width), np.uint8))
        masks = {
            int(n): cv2.resize(np.where(labels == n, 255, 0).astype(np.uint8), size) > 127
            for n in np.unique(labels[labels > 0])
        }
        left = _LEFT + column * (across + _GAP)
        cells = [_seen(frame, camera, masks, size)]
        cells.append(_depth(frame.depth[camera], size) if camera in frame.depth else cells[0][:0])
        cells.append(_flow(frame, camera, masks, size, p95_px) if camera in frame.flow else cells[0][:0])
        write(plate, left, tops[0] + (down - size[1]) // 2 - 10, camera, 0.6, _MUTED)
        for top, cell in zip(tops, cells, strict=True):
            upper = top + (down - len(cell)) // 2
            plate[upper : upper + len(cell), left : left + across] = cell
    if frame.depth:
        _draw_depth_key(plate, key, tops[1], down)
    if p95_px > 0:
        _draw_flow_key(plate, key, tops[2], p95_px)
    return plate


def _seen(frame: KeyFrame, camera: str, masks: dict[int, BoolArray], size: tuple[int, int]) -> UInt8Array:
    image = np.asarray(cv2.resize(frame.images[camera], size, interpolation=cv2.INTER_AREA), np.uint8)
    taken: list[tuple[float, float]] = []
    for label, mask in masks.items():
        colour = colour_of(frame.track_ids[label], FEW) if label in frame.track_ids else "#ffffff"
        image[mask] = (0.55 * image[mask] + 0.45 * np.array(_rgb(colour))).astype(np.uint8)
        _outline(image, mask, colour)
        track = f"#{frame.track_ids[label]}" if label in frame.track_ids else "new"
        _name(image, mask, f"{track}  {frame.ranges[label]:.2f} m" if label in frame.ranges else track, taken)
    return image


def _outline(image: UInt8Array, mask: BoolArray, colour: str) -> None:
    for contour in cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
        cv2.polylines(image, [contour], True, _rgb(colour), 1, cv2.LINE_AA)


def _name(image: UInt8Array, mask: BoolArray, caption: str, taken: list[tuple[float, float]]) -> None:
    """Writes a caption as near to the drone as possible, within the image and off the lines of captions nearby."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    wide, high = _width_of(caption, 0.5), 18
    left = float(np.clip((columns[0] + columns[-1] - wide) / 2, 0, max(image.shape[1] - wide, 0)))
    bases = [float(rows[0] - 6), float(rows[-1] + high)]
    bases += [rows[0] - 6 - n * high for n in (1, 2)] + [rows[-1] + n * high for n in (2, 3)]
    inside = [base for base in bases if high <= base <= len(image) - 4] or bases[:1]
    free = (base for base in inside if all(abs(base - y) >= high or abs(left - x) >= 1.5 * wide for x, y in taken))
    taken.append((left, next(free, inside[0])))
    write(image, *taken[-1], caption, 0.5)


def _depth(depth_m: NDArray[np.floating], size: tuple[int, int]) -> UInt8Array:
    coloured = _DEPTH_COLOURS(_DEPTH_NORM(np.ma.masked_invalid(depth_m)), bytes=True)[..., :3]
    return np.asarray(cv2.resize(np.ascontiguousarray(coloured), size, interpolation=cv2.INTER_NEAREST), np.uint8)


def _flow(
    frame: KeyFrame, camera: str, masks: dict[int, BoolArray], size: tuple[int, int], p95_px: float
) -> UInt8Array:
    """Arrows on the darkened image, the fastest 1.6 times as long as they are apart; a thick one for each drone."""
    flow = frame.flow[camera]
    grey = cv2.cvtColor(cv2.resize(frame.images[camera], size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    cell = np.asarray(cv2.cvtColor((grey * 0.45).astype(np.uint8), cv2.COLOR_GRAY2RGB), np.uint8)
    scale = size[0] / flow.shape[1]
    spacing = max(flow.shape[1] // _ARROWS_ACROSS, 1)
    longer = scale * 1.6 * spacing / p95_px if p95_px > 0 else 0.0
    for row in range(spacing // 2, flow.shape[0], spacing):
        for column in range(spacing // 2, flow.shape[1], spacing):
            _arrow(cell, scale * (np.array([column, row]) + 0.5), longer * flow[row, column], 2)
    for label, mask in masks.items():
        _outline(cell, mask, "#ffffff")
        own = flow[(frame.labels[camera] == label) & np.isfinite(flow).all(axis=2)]
        if len(own):
            rows, columns = np.nonzero(mask)
            _arrow(cell, np.array([columns.mean(), rows.mean()]), longer * np.median(own, axis=0), 4)
    return cell


def _arrow(cell: UInt8Array, start: NDArray[np.floating], along: NDArray[np.floating], thick: int) -> None:
    length = float(np.hypot(*along))
    if not length >= 1.0:  # too short to be seen, or unknown
        return
    colour = "#{:02x}{:02x}{:02x}".format(*(255 * _direction_colours(*along)).astype(int))
    tip, back = start + along, along / length * min(3.0 * thick + 2.0, length)
    across = 0.5 * np.array([-back[1], back[0]])
    _line(cell, np.stack([start, tip]), colour, thick)
    _line(cell, np.stack([tip - back + across, tip, tip - back - across]), colour, thick)


def _typical_flow(frame: KeyFrame) -> float:
    """The 95th percentile of the flow's length over all cameras, camera pixels; 0 without flow."""
    lengths = [np.linalg.norm(flow[::4, ::4], axis=2).ravel() for flow in frame.flow.values()]
    known = np.concatenate(lengths) if lengths else np.zeros(0)
    known = known[np.isfinite(known)]
    return float(np.percentile(known, 95)) if len(known) else 0.0


def _direction_colours(u: NDArray[np.floating], v: NDArray[np.floating]) -> NDArray[np.floating]:
    """(..., 3) a hue for each direction, light enough to be seen on dark."""
    hue = (np.arctan2(-v, u) / (2 * np.pi)) % 1.0
    return hsv_to_rgb(np.stack([hue, np.full_like(hue, 0.62), np.ones_like(hue)], axis=-1))


def _draw_depth_key(plate: UInt8Array, left: int, top: int, height: int) -> None:
    """The colours of depths, near below."""
    plate[top : top + height, left : left + 19] = _depth(np.geomspace(50.0, 1.0, height)[:, None], (19, height))
    for depth_m in _DEPTH_TICKS_M:
        middle = top + (1.0 - float(_DEPTH_NORM(depth_m))) * height
        write(plate, left + 27, np.clip(middle + 6, top + 12, top + height), f"{depth_m} m", 0.5, _INK)


def _draw_flow_key(plate: UInt8Array, left: int, top: int, p95_px: float) -> None:
    """A wheel of directions and how long the arrows are."""
    x, y = np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-1, 1, 80))
    opacity = np.clip(40 * np.minimum(1 - np.hypot(x, y), np.hypot(x, y) - 0.45), 0, 1)[..., None]
    wheel = opacity * 255 * _direction_colours(x, y) + (1 - opacity) * np.array(_rgb(_PLATE))
    plate[top : top + 80, left + 18 : left + 98] = wheel
    for row, text in enumerate(("95 % under", f"{p95_px:.1f} px")):
        write(plate, left + 58 - _width_of(text, 0.5) / 2, top + 102 + 20 * row, text, 0.5, _INK)


def _rig_place(camera: str) -> int:
    """A camera's place in the reading order."""
    return _RIG_ORDER.index(camera) if camera in _RIG_ORDER else len(_RIG_ORDER)


def _rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue of a colour such as `#0072b2`."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _line(image: UInt8Array, pixels: FloatArray, colour: str, thick: int) -> None:
    """Draws a line through pixels (n, 2), whose centres are at +0.5."""
    fixed = np.round((pixels - 0.5) * (1 << _SHIFT)).astype(np.int32)  # as OpenCV wants them with a shift
    cv2.polylines(image, [fixed], False, _rgb(colour), thick, cv2.LINE_AA, _SHIFT)


def _width_of(text: str, size: float) -> int:
    """Width of a text in pixels."""
    return int(cv2.getTextSize(text, _FONT, size, 1)[0][0])


def write(image: UInt8Array, left: float, base: float, text: str, size: float, colour: str = "#ffffff") -> None:
    """Writes a text, ASCII alone, with a dark rim; ``left`` and ``base`` are pixels of its lower left corner."""
    shown, (x, y) = text.encode("ascii", "replace").decode(), (round(left), round(base))
    for across, down in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        cv2.putText(image, shown, (x + across, y + down), _FONT, size, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.putText(image, shown, (x, y), _FONT, size, _rgb(colour), 1, cv2.LINE_AA)

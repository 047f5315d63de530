"""Figures of a flight's key frames: what one drone's cameras saw, with detections, depth and optical flow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from matplotlib import colormaps, patheffects, rc_context
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, hsv_to_rgb, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from flockd.core.messages import BoolArray, FloatArray
from flockd.review.flight_log.key_frames import KeyFrame
from flockd.review.report.style import FEW, STYLE, colour_of

RIG_ORDER = ("left", "front", "right", "back")
"""Reading order of the cameras: a turn to the right. Cameras of other names follow in their own order."""


# A plate as dark as film under either scheme of the page, so that the images appear alike in both.

_PLATE = "#14181f"
_INK = "#e8ecf1"
_MUTED = "#98a3b0"
_SKY = "#26303d"
_DEPTH_NORM = LogNorm(1.0, 50.0)
_DEPTH_COLOURS = colormaps["magma_r"].with_extremes(bad=_SKY)
_DEPTH_TICKS_M = (1, 2, 5, 10, 20, 50)
_HALO = (patheffects.withStroke(linewidth=2.0, foreground="#000000b0"),)

# Inches of the plate.
_WIDTH = 8.6
_LEFT, _RIGHT, _TOP, _BOTTOM, _GAP = 0.3, 0.78, 0.62, 0.14, 0.05


def filmstrip_figure(frame: KeyFrame) -> Figure:
    """One moment: a row of camera images with the drones found in them, a row of depth, a row of flow."""
    cameras = sorted(frame.cameras, key=_rig_place)
    cell_w = min((_WIDTH - _LEFT - _RIGHT - _GAP * (len(cameras) - 1)) / len(cameras), 3.2)
    cell_h = cell_w * max(image.shape[0] / image.shape[1] for image in frame.images.values())
    width = _LEFT + _RIGHT + len(cameras) * (cell_w + _GAP) - _GAP
    height = _TOP + _BOTTOM + 3 * (cell_h + _GAP) - _GAP
    with rc_context({**STYLE, "text.color": _INK}):
        figure = Figure(figsize=(width, height), dpi=160, facecolor=_PLATE)
        # One system of axes in inches from the plate's upper left corner: one an image would take twice as long.
        axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0), autoscale_on=False)
        axes.set_axis_off()

        def cell(row: int, column: int, image: NDArray[np.generic]) -> _Cell:
            scale = cell_w / image.shape[1]
            left, top = _LEFT + column * (cell_w + _GAP), _TOP + row * (cell_h + _GAP)
            return _Cell(axes, left, top + (cell_h - scale * image.shape[0]) / 2, scale, (*image.shape[:2],))

        axes.text(
            _LEFT, 0.12, f"{frame.title}, t = {frame.time_s:.1f} s",
            ha="left", va="top", fontsize=11, fontweight="bold",
        )  # fmt: skip
        for row, name in enumerate(("image", "depth", "flow")):
            middle = _TOP + row * (cell_h + _GAP) + cell_h / 2
            axes.text(0.16, middle, name, rotation=90, ha="center", va="center", color=_MUTED, fontsize=9)
        p95_px = _typical_flow(frame)
        for column, camera in enumerate(cameras):
            seen = cell(0, column, frame.images[camera])
            axes.text(seen.left, seen.top - 0.04, camera, color=_MUTED, fontsize=9)
            _draw_seen(seen, frame, camera)
            if camera in frame.depth:
                depth = np.ma.masked_invalid(frame.depth[camera])
                cell(1, column, depth).show(depth, cmap=_DEPTH_COLOURS, norm=_DEPTH_NORM, interpolation="nearest")
            if camera in frame.flow:
                _draw_flow(cell(2, column, frame.flow[camera]), frame, camera, p95_px)
        key = _LEFT + len(cameras) * (cell_w + _GAP)
        if frame.depth:
            _draw_depth_key(axes, key, _TOP + cell_h + _GAP, cell_h)
        if p95_px > 0:
            _draw_flow_key(axes, key, _TOP + 2 * (cell_h + _GAP), p95_px)
    return figure


@dataclass(frozen=True, eq=False)
class _Cell:
    """Where an image is on the plate: what is drawn into it comes in the image's pixels and is cut at its borders."""

    axes: Axes
    left: float
    """Inches, as ``top``."""
    top: float
    scale: float
    """Inches a pixel."""
    shape: tuple[int, int]
    """(h, w) pixels."""

    @property
    def border(self) -> Rectangle:
        """Border of the image."""
        size = self.scale * self.shape[1], self.scale * self.shape[0]
        return Rectangle((self.left, self.top), *size, transform=self.axes.transData)

    def x(self, columns: FloatArray) -> FloatArray:
        """Inches across the plate."""
        return self.left + self.scale * columns

    def y(self, rows: FloatArray) -> FloatArray:
        """Inches down the plate."""
        return self.top + self.scale * rows

    def show(self, image: NDArray[np.generic], **style: object) -> None:
        """Fills the cell."""
        box = self.border.get_bbox()
        self.axes.imshow(image, extent=(box.x0, box.x1, box.y1, box.y0), aspect="auto", **style)  # type: ignore[arg-type]


def _rig_place(camera: str) -> int:
    return RIG_ORDER.index(camera) if camera in RIG_ORDER else len(RIG_ORDER)


def _draw_seen(cell: _Cell, frame: KeyFrame, camera: str) -> None:
    image = frame.images[camera]
    labels = frame.labels.get(camera, np.zeros(image.shape[:2], np.uint8))
    tinted = image.astype(np.float32)
    found = [int(label) for label in np.unique(labels) if label != 0]
    for label in found:
        colour = 255 * np.array(to_rgb(_track_colour(frame, label)))
        tinted[labels == label] = 0.55 * tinted[labels == label] + 0.45 * colour
    cell.show(tinted.astype(np.uint8), interpolation="bilinear")
    taken: list[_Box] = []
    for label in found:
        _outline(cell, labels == label, _track_colour(frame, label))
        taken.append(_name(cell, labels == label, _caption(frame, label), taken))


def _track_colour(frame: KeyFrame, label: int) -> str:
    return colour_of(frame.track_ids[label], FEW) if label in frame.track_ids else "#ffffff"


def _caption(frame: KeyFrame, label: int) -> str:
    track = f"#{frame.track_ids[label]}" if label in frame.track_ids else "new"
    return f"{track}  {frame.ranges[label]:.2f} m" if label in frame.ranges else track


def _outline(cell: _Cell, mask: BoolArray, colour: str) -> None:
    # Of the mask's own rectangle, not of the whole image. A border of nothing closes an outline that the image's edge
    # cuts.
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    padded = np.pad(mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], 1).astype(float)
    x = cell.x(np.arange(columns[0] - 0.5, columns[-1] + 2))
    y = cell.y(np.arange(rows[0] - 0.5, rows[-1] + 2))
    cell.axes.contour(x, y, padded, levels=[0.5], colors=[colour], linewidths=0.8).set_clip_path(cell.border)


_Box = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels."""


def _name(cell: _Cell, mask: BoolArray, caption: str, taken: Sequence[_Box]) -> _Box:
    """Written as near to the drone as there is room, within the image and clear of the names already there."""
    height, width = mask.shape
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    half, line = 0.018 * width * len(caption), 0.034 * height
    x = float(np.clip((columns[0] + columns[-1] + 1) / 2, half, width - half))
    tops = [rows[0] - 1.3 * line, rows[-1] + 0.3 * line]
    tops += [rows[0] - lines * line for lines in (2.3, 3.3)] + [rows[-1] + lines * line for lines in (1.3, 2.3)]
    boxes = [(x - half, float(top), x + half, float(top) + line) for top in tops if 0 <= top <= height - line]
    free = (box for box in boxes if not any(_overlap(box, other) for other in taken))
    box = next(free, boxes[0])
    cell.axes.text(
        float(cell.x(np.array(x))), float(cell.y(np.array(box[1] + line / 2))), caption, ha="center", va="center",
        color="#ffffff", fontsize=7, fontweight="bold", path_effects=_HALO,
    )  # fmt: skip
    return box


def _overlap(one: _Box, other: _Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _draw_depth_key(axes: Axes, left: float, top: float, height: float) -> None:
    """The colours of depths, near below."""
    low, high = _DEPTH_NORM.vmin or 1.0, _DEPTH_NORM.vmax or 1.0
    bar = np.geomspace(high, low, 256)[:, None]
    extent = (left, left + 0.12, top + height, top)
    axes.imshow(bar, extent=extent, aspect="auto", cmap=_DEPTH_COLOURS, norm=_DEPTH_NORM)
    for depth_m in _DEPTH_TICKS_M:
        down = 1.0 - float(_DEPTH_NORM(depth_m))
        axes.text(left + 0.17, top + down * height, f"{depth_m} m", va="center", fontsize=8.5)


_ARROWS_ACROSS = 14
"""The flow is drawn once in each of this many cells across the image, and once for each drone."""


def _typical_flow(frame: KeyFrame) -> float:
    """The 95th percentile of the flow's length over all cameras, camera pixels; 0 without flow."""
    lengths = [np.linalg.norm(flow[::4, ::4], axis=2).ravel() for flow in frame.flow.values()]
    known = np.concatenate(lengths) if lengths else np.zeros(0)
    known = known[np.isfinite(known)]
    return float(np.percentile(known, 95)) if len(known) else 0.0


def _direction_colours(u: NDArray[np.floating], v: NDArray[np.floating]) -> NDArray[np.floating]:
    """(n, 3) a hue for each direction, light enough to be seen on dark."""
    hue = (np.arctan2(-v, u) / (2 * np.pi)) % 1.0
    return hsv_to_rgb(np.stack([hue, np.full_like(hue, 0.62), np.ones_like(hue)], axis=-1))


def _draw_flow(cell: _Cell, frame: KeyFrame, camera: str, p95_px: float) -> None:
    flow = frame.flow[camera]
    grey = cv2.cvtColor(np.ascontiguousarray(frame.images[camera]), cv2.COLOR_RGB2GRAY)
    cell.show(grey, cmap="gray", vmin=0, vmax=560, interpolation="bilinear")
    if p95_px == 0:
        return
    spacing = max(flow.shape[1] // _ARROWS_ACROSS, 1)
    scale = p95_px / (1.6 * spacing)
    rows, columns = (
        axis.ravel()
        for axis in np.mgrid[spacing // 2 : flow.shape[0] : spacing, spacing // 2 : flow.shape[1] : spacing]
    )
    _arrows(cell, columns + 0.5, rows + 0.5, flow[rows, columns], scale)
    labels = frame.labels.get(camera, np.zeros(flow.shape[:2], np.uint8))
    for label in np.unique(labels[labels > 0]):
        mask = labels == label
        _outline(cell, mask, "#ffffff")
        own = flow[mask & np.isfinite(flow).all(axis=2)]
        if len(own):
            rows, columns = np.nonzero(mask)
            middle = np.median(own, axis=0)[None]
            _arrows(cell, columns.mean(keepdims=True) + 0.5, rows.mean(keepdims=True) + 0.5, middle, scale, width=0.014)


def _arrows(
    cell: _Cell, x: FloatArray, y: FloatArray, flow: NDArray[np.floating], scale: float, *, width: float = 0.007
) -> None:
    """`flow` (n, 2) camera pixels; `scale` is how many of them one of these pixels shows; `width` a share of the
    image's."""
    u, v = flow.T
    known = np.isfinite(u) & np.isfinite(v)
    arrows = cell.axes.quiver(
        cell.x(x[known]), cell.y(y[known]), u[known], v[known],
        color=_direction_colours(u[known], v[known]), angles="xy", scale_units="xy", scale=scale / cell.scale,
        units="inches", width=width * cell.scale * cell.shape[1],
        headwidth=3.4, headlength=4.0, headaxislength=3.4, minlength=0.3,
    )  # fmt: skip
    arrows.set_clip_path(cell.border)


def _draw_flow_key(axes: Axes, left: float, top: float, p95_px: float) -> None:
    """A wheel of directions and how long the arrows are."""
    x, y = np.meshgrid(np.linspace(-1, 1, 96), np.linspace(-1, 1, 96))
    radius = np.hypot(x, y)
    opacity = np.clip(48 * np.minimum(1 - radius, radius - 0.45), 0, 1)
    middle, size = left + (_RIGHT - _GAP) / 2, 0.5
    extent = (middle - size / 2, middle + size / 2, top + size, top)
    axes.imshow(np.dstack([_direction_colours(x, y), opacity]), extent=extent, aspect="auto")
    axes.text(middle, top + size + 0.06, f"95 % under\n{p95_px:.1f} px", ha="center", va="top", fontsize=8)

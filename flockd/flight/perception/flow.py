"""Optical flow: dense, by a network or by OpenCV's DIS, then refined on a grid of points."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import UNCLASSED, BoolArray, Float32Array, UInt8Array
from flockd.flight.geometry.robust.kernels import median
from flockd.flight.inference.fitting import fit
from flockd.flight.inference.session import OnnxModel

_GRID_PX = 16
"""Distance of the points. With 8 px the flow between them is as exact, for three times the time."""
_WINDOW_PX = 9
_HALVINGS = 2
"""Pyramid levels of the images: errors of the flow up to some 20 px are corrected."""
_STEPS = 10
_CONVERGED_PX = 0.03
_MIN_EIGENVALUE = 1e-4
"""Least eigenvalue of the structure tensor, in OpenCV's units; below it a point has no texture to track."""
_DIFFERENCE_LEVELS = 4.0
"""Difference of the windows in grey levels at which a point has half weight."""
_ASTRAY_PX = 3.0
"""Distance of a point's motion from the median of the nine around it at which it has half weight."""
_ALONE, _RETURNS_PX = 0.5, 1.0
"""An outlier beyond this share of `_ASTRAY_PX` keeps its weight if tracking backwards, started from the median motion,
ends within the second number of pixels of its start: thin near things move differently from what is around them."""
_MIN_WEIGHT = 1e-4
_OWN_WEIGHT = np.float32(0.25)
"""Weight above which a point keeps its own flow; below, it takes a share of its surroundings' flow."""
_DRONE_MARGIN_PX = 20
"""Points and flow within this distance of a drone are not used: both contain the drone's own motion."""
_PYRAMID_LEVELS = 3
"""Halvings of the grid over which flow spreads."""
_SURROUNDINGS_WEIGHT = 0.1
"""Weight of the surroundings, as a point of this weight."""
_HOMOGRAPHY_STRIDE = 2
"""Every second point in each direction is enough for the homography."""
_HOMOGRAPHY_MIN_WEIGHT = 0.5
_HOMOGRAPHY_MIN_POINTS = 30
_HOMOGRAPHY_TOLERANCE_PX = 4.0
_HOMOGRAPHY_MAX_ERROR = 0.25
"""Largest median error of a useful homography, relative to the image's width."""


class DisFlow:
    """OpenCV's dense inverse search (Kroeger et al. 2016): alone on small computers, or after another flow.

    It is exact to a fraction of a pixel if it converges, but loses large motions; a network is the opposite.
    """

    def __init__(self, start: OnnxFlow | None = None) -> None:
        """``start``: the flow that initialises the coarsest scale; None: no motion."""
        self._start = start
        self._idle: list[cv2.DISOpticalFlow] = []
        """Instances not in use: none serves two callers at once. Reusing one's memory saves a third of the time."""

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 3) RGB twice -> (h, w, 2): the displacement of each pixel of the first image, right and down."""
        before, after = grey(first), grey(second)
        start = np.zeros((*before.shape, 2), np.float32) if self._start is None else self._start.flow(first, second)
        dis = self._idle.pop() if self._idle else cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        try:
            return np.asarray(dis.calc(before, after, start), dtype=np.float32)
        finally:
            self._idle.append(dis)


class OnnxFlow:
    """A flow network; scales images as its manifest asks."""

    def __init__(self, model: OnnxModel) -> None:
        self._model = model

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        """(h, w, 3) RGB twice -> (h, w, 2): the displacement of each pixel of the first image, right and down."""
        height, width = first.shape[:2]
        fitting = fit(self._model.manifest, (width, height))
        outputs = self._model.infer({"first": [fitting.enter(first)], "second": [fitting.enter(second)]})
        flow = fitting.inside(outputs["flow"])[0].transpose(1, 2, 0) / np.array(fitting.scale, np.float32)
        full = cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(full, dtype=np.float32)


def grid_flow(flow: Float32Array, first: UInt8Array, second: UInt8Array, labels: UInt8Array) -> Float32Array:
    """Refines the background's flow by Lucas & Kanade (1981; Bouguet 2001) at points 16 px apart.

    Corrections are interpolated between points. A point that is an outlier and fails the backward check (Kalal et al.
    2010) takes the corrections around it. A point without texture, such as sky, or beside a drone takes the differences
    around it from the homography that most points follow (normalised convolution, Knutsson & Westin 1993, over a
    pyramid).

    Args:
        flow: (h, w, 2) pixels from the first image to the second, with errors of up to some 20 px.
        first: (h, w, 3) RGB.
        second: (h, w, 3) RGB.
        labels: (h, w) of the first image: 0 the background, 255 not to be used, else one value a drone, whose pixels
            keep their flow.
    """
    height, width = labels.shape
    points = _points((width, height))
    size = points.shape[1], points.shape[0]
    column, row = points.astype(np.intp).transpose(2, 0, 1)
    start = flow[row, column]
    drones = np.asarray(cv2.inRange(labels, 1, UNCLASSED - 1), np.uint8)
    moved, weight, textured = _followed(grey(first), grey(second), points, start)
    beside = _beside(drones, size)
    weight[beside] = 0.0
    own, sure = np.minimum(weight / _OWN_WEIGHT, 1.0)[..., None], weight + np.float32(_MIN_WEIGHT)
    plane = _homography_flow(points, moved, weight, width)
    unseen = _spread(moved - plane, sure) + plane
    seen = _spread(moved - start, sure) + start
    settled = own * moved + (1.0 - own) * np.where((textured & ~beside)[..., None], seen, unseen)
    full = np.asarray(cv2.add(flow, _between(settled - start, (width, height))), np.float32)
    left, top, columns, rows = cv2.boundingRect(drones)
    if columns:
        box = np.s_[max(top - _DRONE_MARGIN_PX, 0) : top + rows + _DRONE_MARGIN_PX,
                    max(left - _DRONE_MARGIN_PX, 0) : left + columns + _DRONE_MARGIN_PX]  # fmt: skip
        around = np.ascontiguousarray(full[box])
        near = cv2.dilate(drones[box], np.ones((3, 3), np.uint8), iterations=_DRONE_MARGIN_PX)
        cv2.copyTo(_between(settled, (width, height))[box], near, around)
        cv2.copyTo(flow[box], drones[box], around)
        full[box] = around
    return full


def _followed(
    first: UInt8Array, second: UInt8Array, points: Float32Array, start: Float32Array
) -> tuple[Float32Array, Float32Array, BoolArray]:
    """Motions (n, m, 2) of points (n, m, 2) of grey images, their weights, and where there is texture."""
    begin = points.reshape(-1, 1, 2)
    end, status, difference = _tracked(first, second, begin, begin + start.reshape(-1, 1, 2))
    shape = points.shape[:2]
    found = (status.reshape(shape) > 0) & np.isfinite(end).all(axis=2).reshape(shape)
    moved = np.where(found[..., None], (end - begin).reshape(points.shape), start)
    change = moved - start
    usual = cv2.merge([cv2.medianBlur(axis, 3) for axis in cv2.split(change)])
    astray = np.abs(change - usual).sum(axis=2) / _ASTRAY_PX
    if len(alone := (found & (astray > _ALONE)).ravel().nonzero()[0]):
        there = end[alone]
        back, seen, _ = _tracked(second, first, there, there - (start + usual).reshape(-1, 1, 2)[alone])
        returns = (seen[:, 0] > 0) & (np.abs(back - begin[alone]).sum(axis=(1, 2)) < _RETURNS_PX)
        astray.flat[alone[returns]] = 0.0
    unlike = np.where(found, difference.reshape(shape), 0.0) / _DIFFERENCE_LEVELS
    weight = np.asarray(found / ((1.0 + unlike**2) * (1.0 + astray**2)), np.float32)
    return moved, weight, found


def _tracked(
    first: UInt8Array, second: UInt8Array, points: Float32Array, start: Float32Array
) -> tuple[Float32Array, UInt8Array, Float32Array]:
    """Tracks points (n, 1, 2) into the second grey image from ``start``: positions, 1 if found, change of grey."""
    end, status, difference = cv2.calcOpticalFlowPyrLK(
        first, second, np.ascontiguousarray(points), np.ascontiguousarray(start), winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_HALVINGS, criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _STEPS, _CONVERGED_PX),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=_MIN_EIGENVALUE,
    )  # fmt: skip
    return np.asarray(end, np.float32), np.asarray(status, np.uint8), np.asarray(difference, np.float32)


def _beside(drones: UInt8Array, size: tuple[int, int]) -> BoolArray:
    """Which points are on a drone or beside one."""
    cells = cv2.resize(drones, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.dilate(cells, np.ones((3, 3), np.uint8), iterations=-(-_DRONE_MARGIN_PX // _GRID_PX)) > 0)


@lru_cache(maxsize=8)
def _points(size: tuple[int, int]) -> Float32Array:
    """(n, m, 2) pixels of `grid_pixels` of an image of (width, height), with whole numbers as centres; read only."""
    u, v = (np.arange(min(_GRID_PX, length) // 2, length, _GRID_PX) for length in size)
    return np.stack(np.meshgrid(u, v), axis=2).astype(np.float32)


def _between(at_points: Float32Array, size: tuple[int, int]) -> Float32Array:
    """(h, w, 2) of an image of (width, height), interpolated from values at the points (n, m, 2)."""
    rows, columns = (_GRID_PX * count for count in at_points.shape[:2])
    full = cv2.resize(at_points, (columns, rows), interpolation=cv2.INTER_LINEAR)[: size[1], : size[0]]
    beyond = size[1] - full.shape[0], size[0] - full.shape[1]
    if any(beyond):
        full = cv2.copyMakeBorder(full, 0, beyond[0], 0, beyond[1], cv2.BORDER_REPLICATE)
    return np.asarray(full, np.float32)


def _homography_flow(points: Float32Array, moved: Float32Array, weight: Float32Array, width: int) -> Float32Array:
    """The flow of the homography that most certain points follow, at all points; zero if there is none."""
    none = np.zeros_like(moved)
    some = np.s_[::_HOMOGRAPHY_STRIDE, ::_HOMOGRAPHY_STRIDE]
    sure = weight[some] > _HOMOGRAPHY_MIN_WEIGHT
    begin, end = points[some][sure], (points + moved)[some][sure]
    if len(begin) < _HOMOGRAPHY_MIN_POINTS:
        return none
    found, _ = cv2.findHomography(begin, end, cv2.USAC_MAGSAC, _HOMOGRAPHY_TOLERANCE_PX)
    if found is None:
        return none
    along = (cv2.perspectiveTransform(points, np.asarray(found, np.float64)) - points).astype(np.float32)
    off = np.sqrt(((along - moved) ** 2).sum(axis=2))
    usable = np.isfinite(along).all() and median(off.ravel()) < _HOMOGRAPHY_MAX_ERROR * width and off.max() < width
    return along if usable else none


def _spread(values: Float32Array, weight: Float32Array) -> Float32Array:
    """(n, m, 2) each point's own value by its weight (n, m), its surroundings' by a fixed one."""
    levels: list[tuple[NDArray[Any], NDArray[Any]]] = [(values * weight[..., None], weight)]
    for _ in range(_PYRAMID_LEVELS):
        levels.append((cv2.pyrDown(levels[-1][0]), cv2.pyrDown(levels[-1][1])))
    around = levels[-1][0] / levels[-1][1][..., None]
    share = _SURROUNDINGS_WEIGHT
    for sums, weights in levels[-2::-1]:
        wider = cv2.pyrUp(around, dstsize=(weights.shape[1], weights.shape[0]))
        around = (sums + share * wider) / (weights + share)[..., None]
    return np.asarray(around, np.float32)


def grey(image: UInt8Array) -> UInt8Array:
    """(h, w) grey levels of (h, w, 3) RGB."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)

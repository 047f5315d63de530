"""Where drones went: a flow of the whole image loses what is small and moves otherwise than all behind it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.messages import UNCLASSED, BoolArray, Float32Array, FloatArray, UInt8Array

_LEAST_PIXELS, _MOST_PIXELS = 12, 600
"""Of a drone, for its motion to be found at all; and as many of them as are looked at."""
_CERTAIN, _PLAUSIBLE = 0.85, 0.5
"""Likeness of a drone before and after: from here on no other place is tried; below this, none is believed."""
_OF_THE_SEEN = 0.3
"""Likeness is less, by this power of the share of the drone that is seen in both, where it leaves the image."""
_REACH_PX = 80
"""As far from where its surroundings went a drone is searched for."""
_SURROUNDINGS_PX = 16
_PLACES = 3
_STEPS: tuple[tuple[float, int, int], ...] = ((2.0, 3, 12), (1.0, 6, 10), (0.6, 10, 12))
"""How smooth the images are, how many terms the motion has (affine, of second, of third order), and how often
they are mended at most."""
_STIFFNESS = 0.005
_GAIN = 0.01
_CONVERGED_PX = 0.1
_LONGEST_STEP_PX = 3.0
_MARGIN_PX = 24
_LEAST_NOISE = 2.0
"""Grey levels by which a pixel may differ without counting for less."""
_MOST_RELIEF_PX = 3.0
"""What single pixels may move apart from the whole drone."""
_RELIEF_SMOOTHNESS, _RELIEF_SLOPES = 5.0, 20.0
"""Weights of neighbours moving alike and of the image's slopes being kept, where 5 is that of the grey levels."""


def follow_drones(flow: Float32Array, first: UInt8Array, second: UInt8Array, labels: UInt8Array) -> Float32Array:
    """The flow with that of each drone found by itself, wherever that can be.

    A drone is searched for by its colours around where its surroundings went, unless it is where the flow says. Its
    motion is a polynomial of third order, found by aligning its pixels (Lucas & Kanade 1981; Baker & Matthews 2004);
    to that comes what single pixels differ from it (variational refinement, Brox et al. 2004).

    Args:
        flow: (h, w, 2) pixels from the first image to the second.
        first: (h, w, 3) RGB.
        second: (h, w, 3) RGB.
        labels: (h, w) of the first image: one value a drone, 0 and 255 no drone.
    """
    areas = cv2.calcHist([labels], [0], None, [256], [0.0, 256.0]).ravel()  # its shape depends on OpenCV
    areas[[0, UNCLASSED]] = 0
    found = flow.copy() if (areas >= _LEAST_PIXELS).any() else flow
    for label in np.flatnonzero(areas >= _LEAST_PIXELS):
        _follow(_Outline(*np.nonzero(labels == label)), flow, first, second, found, labels)
    return found


@dataclass(frozen=True, eq=False)
class _Outline:
    """All pixels of one drone."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    def box(self, margin: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
        """With a margin, inside the image."""
        top, left = max(int(self.rows.min()) - margin, 0), max(int(self.columns.min()) - margin, 0)
        bottom, right = int(self.rows.max()) + margin + 1, int(self.columns.max()) + margin + 1
        return slice(top, min(bottom, shape[0])), slice(left, min(right, shape[1]))


def _follow(
    drone: _Outline, flow: Float32Array, first: UInt8Array, second: UInt8Array, found: Float32Array, labels: UInt8Array
) -> None:
    """Writes one drone's flow where it is found."""
    said = np.median(flow[drone.rows, drone.columns], axis=0).astype(np.float64)
    before = _Before(drone, first)
    best = _finely(before, second, _roughly(before, second, said))
    if best is None or best.likeness < _CERTAIN:
        box = drone.box(_SURROUNDINGS_PX, labels.shape)
        around = flow[box][labels[box] == 0]
        beside = np.median(around, axis=0).astype(np.float64) if len(around) else said
        places = [_roughly(before, second, place) for place in (beside, *_places(drone, first, second, beside))]
        likest = max((place for place in places if place), key=lambda place: place.likeness, default=None)
        other = _finely(before, second, likest)
        if other and (best is None or other.likeness > best.likeness):
            best = other
    if best is None or best.likeness < _PLAUSIBLE:
        return
    whole = best.at(drone.rows.astype(np.float64), drone.columns.astype(np.float64))
    found[drone.rows, drone.columns] = whole + _relief(drone, first, second, best)


class _Before:
    """Some of a drone's pixels in the first image."""

    def __init__(self, drone: _Outline, first: UInt8Array) -> None:
        chosen = np.linspace(0, len(drone.rows) - 1, min(len(drone.rows), _MOST_PIXELS)).astype(np.int64)
        self.drone = drone
        self.rows, self.columns = drone.rows[chosen].astype(np.float64), drone.columns[chosen].astype(np.float64)
        self.middle = np.array([self.columns.mean(), self.rows.mean()])
        apart = np.hypot(self.columns - self.middle[0], self.rows - self.middle[1])
        self.size_px = max(6.0, 1.2 * float(apart.mean()))
        box = drone.box(4, first.shape)
        at = drone.rows[chosen] - box[0].start, drone.columns[chosen] - box[1].start
        self.colours = _smooth(first[box], 1.0)[at].astype(np.float64)
        grey = _grey(first[box])
        self.levels = []
        """For each step of `_STEPS`, (n, 3): grey level, and how it changes to the right and down."""
        for smooth_px, _, _ in _STEPS:
            smooth = _smooth(grey, smooth_px)
            self.levels.append(np.stack([layer[at] for layer in _with_slopes(smooth)], 1).astype(np.float64))

    def places(self, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u and v of them when moved (n, 2)."""
        return self.columns + moved[:, 0], self.rows + moved[:, 1]


@dataclass(frozen=True, eq=False)
class _Motion:
    """Of a whole drone, as polynomials of a pixel's place."""

    middle: FloatArray
    """(2,) of the drone, u and v."""
    size_px: float
    terms: FloatArray
    """(1, 3, 6 or 10, 2) what each term adds right and down."""
    likeness: float = 0.0
    """Correlation of the drone's colours before and after."""

    def at(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """(n, 2) pixels right and down."""
        return self.basis(rows, columns)[:, : len(self.terms)] @ self.terms

    def basis(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """(n, 10) the terms' factors."""
        x, y = (columns - self.middle[0]) / self.size_px, (rows - self.middle[1]) / self.size_px
        xx, yy = x * x, y * y
        return np.stack([np.ones_like(x), x, y, xx, x * y, yy, xx * x, xx * y, x * yy, yy * y], 1)


def _roughly(before: _Before, second: UInt8Array, start: FloatArray) -> _Motion | None:
    """The best affine motion near a shift; None where it leads out of the image."""
    return _fitted(before, second, _Motion(before.middle, before.size_px, start[None]), slice(0, 1))


def _finely(before: _Before, second: UInt8Array, motion: _Motion | None) -> _Motion | None:
    """The best motion of third order near an affine one."""
    return _fitted(before, second, motion, slice(1, None)) if motion else None


def _fitted(before: _Before, second: UInt8Array, motion: _Motion, steps: slice) -> _Motion | None:
    window = _Window(before.drone, second, motion.terms[0])
    basis = motion.basis(before.rows, before.columns)
    for level, (smooth_px, count, rounds) in zip(before.levels[steps], _STEPS[steps], strict=True):
        terms = np.zeros((count, 2))
        terms[: len(motion.terms)] = motion.terms[:count]
        fitted = _mended(basis[:, :count], terms, level, window.layers(smooth_px), window, before, rounds)
        if fitted is None:
            return None
        motion = replace(motion, terms=fitted)
    u, v = before.places(motion.at(before.rows, before.columns))
    seen = window.inside(u, v)
    likeness = _correlation(before.colours[seen], window.sample(window.colours, u, v)[seen])
    return replace(motion, likeness=likeness * float(seen.mean()) ** _OF_THE_SEEN)


class _Window:
    """The part of the second image where a drone may be."""

    def __init__(self, drone: _Outline, second: UInt8Array, start: FloatArray) -> None:
        height, width = second.shape[:2]
        extent = max(np.ptp(drone.rows), np.ptp(drone.columns))
        margin = _MARGIN_PX + int(extent) // 4
        u, v = round(float(start[0])), round(float(start[1]))
        self.left = int(np.clip(drone.columns.min() + u - margin, 0, width - 2))
        self.top = int(np.clip(drone.rows.min() + v - margin, 0, height - 2))
        right = int(np.clip(drone.columns.max() + u + margin, self.left + 2, width))
        bottom = int(np.clip(drone.rows.max() + v + margin, self.top + 2, height))
        rgb = second[self.top : bottom, self.left : right]
        self.colours, self._grey = _smooth(rgb, 1.0), _grey(rgb)

    def layers(self, smooth_px: float) -> Float32Array:
        """(h, w, 3) grey level, and how it changes to the right and down."""
        return np.dstack(_with_slopes(_smooth(self._grey, smooth_px)))

    def inside(self, u: FloatArray, v: FloatArray) -> BoolArray:
        """Which places of the whole image are inside."""
        height, width = self._grey.shape
        u, v = u - self.left, v - self.top
        return np.asarray((u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1))

    def sample(self, layers: Float32Array, u: FloatArray, v: FloatArray) -> FloatArray:
        """(n, 3) at places of the whole image."""
        u32, v32 = (u - self.left).astype(np.float32)[:, None], (v - self.top).astype(np.float32)[:, None]
        found = cv2.remap(layers, u32, v32, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found[:, 0], dtype=np.float64)


def _mended(
    basis: FloatArray, terms: FloatArray, level: FloatArray, after: Float32Array, window: _Window, before: _Before,
    rounds: int,
) -> FloatArray | None:  # fmt: skip
    """Gauss-Newton on the terms and on how much brighter the drone has become; outliers count less."""
    count, grey = len(terms), level[:, 0]
    jacobian = np.ones((len(grey), 2 * count + 2))
    jacobian[:, -1] = (grey - grey.mean()) / 100.0
    for _ in range(rounds):
        u, v = before.places(basis @ terms)
        seen = window.inside(u, v)
        if np.count_nonzero(seen) < _LEAST_PIXELS:
            return None
        there = window.sample(after, u, v)
        off = grey - there[:, 0]
        off -= _middle(off[seen])
        noise = max(_LEAST_NOISE, 1.5 * _middle(np.abs(off[seen])))
        weight = seen / (1.0 + (off / (2.0 * noise)) ** 2)
        slope = (level[:, 1:] + there[:, 1:]) / 2  # of both images: converges from farther (Benhimane & Malis 2004)
        np.multiply(slope[:, :1], basis, out=jacobian[:, :count])
        np.multiply(slope[:, 1:], basis, out=jacobian[:, count : 2 * count])
        weighted = weight[:, None] * jacobian
        normal = jacobian.T @ weighted
        stiff = np.full(2 * count + 2, 1e-6 + 1e-10 * float(normal.trace()))  # stripes tell of one way only
        stiff[1:count] += _STIFFNESS * (normal[0, 0] + normal[count, count]) / 2
        stiff[count + 1 : 2 * count] = stiff[1:count]
        stiff[-1] = _GAIN * len(grey)
        normal[np.diag_indices_from(normal)] += stiff
        step = np.linalg.solve(normal, off @ weighted)
        change = step[: 2 * count].reshape(2, count).T
        change = change * min(1.0, _LONGEST_STEP_PX / max(float(np.abs(change[0]).max()), 1e-9))
        terms = terms + change
        if np.abs(change).max() < _CONVERGED_PX:
            break
    return terms


def _places(drone: _Outline, first: UInt8Array, second: UInt8Array, beside: FloatArray) -> list[FloatArray]:
    """Shifts to where something of a drone's colours is, the likest first."""
    box = drone.box(2, first.shape)
    coarse = 4 if max(box[0].stop - box[0].start, box[1].stop - box[1].start) > 80 else 2
    rows, columns = drone.rows // coarse, drone.columns // coarse
    images = [cv2.resize(i, None, fx=1 / coarse, fy=1 / coarse, interpolation=cv2.INTER_AREA) for i in (first, second)]
    top, left = int(rows.min()), int(columns.min())
    bottom, right = min(int(rows.max()) + 1, len(images[0])), min(int(columns.max()) + 1, images[0].shape[1])
    if bottom - top < 3 or right - left < 3:
        return []
    mask = np.zeros((bottom - top, right - left, 3), np.uint8)
    mask[np.minimum(rows - top, bottom - top - 1), np.minimum(columns - left, right - left - 1)] = 1
    reach, (u, v) = _REACH_PX // coarse, np.round(beside / coarse).astype(int)
    height, width = images[1].shape[:2]
    beyond = (bottom - top) // 2, (right - left) // 2  # half of it may have left the image
    low = max(top + v - reach, -beyond[0]), max(left + u - reach, -beyond[1])
    high = min(bottom + v + reach, height + beyond[0]), min(right + u + reach, width + beyond[1])
    if high[0] - low[0] < bottom - top or high[1] - low[1] < right - left:
        return []
    inside = np.s_[max(low[0], 0) : min(high[0], height), max(low[1], 0) : min(high[1], width)]
    if not images[1][inside].size:
        return []
    searched = cv2.copyMakeBorder(
        images[1][inside], max(-low[0], 0), max(high[0] - height, 0), max(-low[1], 0), max(high[1] - width, 0),
        cv2.BORDER_REPLICATE,
    )  # fmt: skip
    likeness = cv2.matchTemplate(searched, images[0][top:bottom, left:right], cv2.TM_CCOEFF_NORMED, mask=mask)
    likeness[~np.isfinite(likeness)] = -1.0
    apart = max(2, min(mask.shape[:2]) // 3)
    places = []
    for _ in range(_PLACES):
        row, column = np.unravel_index(int(likeness.argmax()), likeness.shape)
        if likeness[row, column] <= 0:
            break
        places.append(coarse * np.array([low[1] + column - left, low[0] + row - top], np.float64))
        likeness[max(row - apart, 0) : row + apart + 1, max(column - apart, 0) : column + apart + 1] = -1.0
    return places


def _relief(drone: _Outline, first: UInt8Array, second: UInt8Array, motion: _Motion) -> FloatArray:
    """(n, 2) what each of its pixels moves apart from the whole drone, px."""
    box = drone.box(8, first.shape)
    v, u = np.mgrid[box].astype(np.float64)
    reach = 2.5 * motion.size_px  # polynomials run wild far off
    near_u = np.clip(u, motion.middle[0] - reach, motion.middle[0] + reach).ravel()
    near_v = np.clip(v, motion.middle[1] - reach, motion.middle[1] + reach).ravel()
    to_u, to_v = motion.at(near_v, near_u).T.reshape(2, *u.shape).astype(np.float32) + np.stack([u, v]).astype(
        np.float32
    )
    there = cv2.remap(second, to_u, to_v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(np.uint8)
    before, after = _grey(first[box]), _grey(there)
    rows, columns = drone.rows - box[0].start, drone.columns - box[1].start
    were, are = before[rows, columns], after[rows, columns]
    contrast = float(np.clip(np.cov(were, are)[0, 1] / max(float(are.var()), 1.0), 0.5, 2.0))
    after = np.clip(were.mean() + contrast * (after - are.mean()), 0, 255)
    refinement = cv2.VariationalRefinement.create()
    refinement.setAlpha(_RELIEF_SMOOTHNESS)
    refinement.setGamma(_RELIEF_SLOPES)
    refinement.setSorIterations(20)
    images = before.astype(np.uint8), after.astype(np.uint8)
    relief = refinement.calc(*images, np.zeros((*before.shape, 2), np.float32))[rows, columns]
    length = np.linalg.norm(relief, axis=1, keepdims=True)
    return np.asarray(relief * np.minimum(1.0, _MOST_RELIEF_PX / np.maximum(length, 1e-6)), np.float64)


def _smooth(image: UInt8Array | Float32Array, sigma_px: float) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), dtype=np.float32)


def _with_slopes(image: Float32Array) -> tuple[Float32Array, Float32Array, Float32Array]:
    """The image, and how its grey levels change to the right and down."""
    right, down = (cv2.Sobel(image, cv2.CV_32F, *way, ksize=1, scale=0.5) for way in ((1, 0), (0, 1)))
    return image, np.asarray(right, np.float32), np.asarray(down, np.float32)


def _grey(image: UInt8Array) -> Float32Array:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.float32)


def _middle(values: FloatArray) -> float:
    """The median, or nearly."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def _correlation(a: FloatArray, b: FloatArray) -> float:
    """Of (n, 3) colours, each channel about its own mean."""
    a, b = a - a.mean(0), b - b.mean(0)
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0 else -1.0

"""The flow of each drone by itself: that of a whole image loses what is small and moves against its background."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import UNCLASSED, BoolArray, Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry.robust.kernels import Cauchy
from flockd.flight.geometry.robust.solver import GaussNewton, NormalEquations, Problem
from flockd.flight.perception.flow.images import grey, smoothed


@dataclass(frozen=True)
class AlignmentStage:
    """One fit of a drone's motion, of coarse ones and finer ones."""

    sigma_px: float
    """Standard deviation of the Gaussian that both images are smoothed with."""
    terms: int
    """Terms of the polynomial: 3 are affine, 6 of second, 10 of third order."""
    optimizer: GaussNewton
    """Tolerance in pixels."""


_MIN_PIXELS = 12
"""Least pixels of a drone, for its motion to be found at all."""
_MAX_PIXELS = 600
"""Drawn of more."""
_CERTAIN_CORRELATION = 0.85
"""Correlation of a drone's colours before and after: from here on no other start is tried."""
_MIN_CORRELATION = 0.5
"""Below this, no motion is believed."""
_VISIBLE_EXPONENT = 0.3
"""Correlation is less, by this power of the share of the drone that is in both images, where it leaves them."""
_SEARCH_RADIUS_PX = 80
"""From where its surroundings went."""
_SURROUNDINGS_PX = 16
"""As far around the drone the flow of its surroundings is measured."""
_MAX_MATCHES = 3
"""Places with the drone's colours that are tried as starts."""
_MATCH_MARGIN = 0.1
"""Places whose correlation is so much below the highest are not tried."""
_AFFINE_STAGE = AlignmentStage(2.0, 3, GaussNewton(max_steps=8, tolerance=0.3))
_HIGHER_ORDER_STAGES = (
    AlignmentStage(1.0, 6, GaussNewton(max_steps=2, tolerance=0.1)),
    AlignmentStage(0.6, 10, GaussNewton(max_steps=2, tolerance=0.1)),
)
"""Two steps are enough: further ones fit the terms to single pixels, whose own motion is found afterwards."""
_TERM_DAMPING = 0.005
"""Damping of all terms but the shift, in units of the shift's own curvature."""
_CONTRAST_DAMPING = 0.01
"""Damping of the change of contrast, a pixel."""
_MAX_STEP_PX = 3.0
"""Farther the linearised image is not the image."""
_WINDOW_MARGIN_PX = 16
"""Around where the drone is thought to be in the second image."""
_CAUCHY_DEVIATIONS = 3.0
"""Cauchy's scale in median absolute deviations: 2.0 standard deviations, where 2.4 are efficient."""
_MIN_CAUCHY_LEVELS = 4.0
"""The least that scale is, grey levels: rounding and noise."""
_MAX_RESIDUAL_PX = 3.0
"""What single pixels may move apart from the whole drone."""
_RESIDUAL_SMOOTHNESS = 5.0
"""Brox et al.'s alpha: weight of neighbours moving alike, where that of the grey levels is 5."""
_RESIDUAL_GRADIENTS = 20.0
"""Their gamma: weight of the image's gradients being kept."""


def object_flow(
    flow: Float32Array,
    first: UInt8Array,
    second: UInt8Array,
    labels: UInt8Array,
) -> Float32Array:
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
    pixels = np.flatnonzero(labels != 0)  # of booleans it takes a seventh of the time
    label_of_pixel = labels.ravel()[pixels]
    large = np.flatnonzero(np.bincount(label_of_pixel)[:UNCLASSED] >= _MIN_PIXELS)
    found = flow.copy() if len(large) else flow
    for label in large:
        region = _Region(*np.divmod(pixels[label_of_pixel == label], labels.shape[1]))
        motion = _motion(region, flow, first, second, labels)
        if motion is not None:
            whole = motion.at(region.rows.astype(np.float64), region.columns.astype(np.float64))
            residual = _residual_flow(region, first, second, motion)
            found[region.rows, region.columns] = whole + residual
    return found


@dataclass(frozen=True, eq=False)
class _Region:
    """All pixels of one drone."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    def box(self, margin: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
        """With a margin, inside the image."""
        top, left = max(int(self.rows.min()) - margin, 0), max(int(self.columns.min()) - margin, 0)
        bottom, right = int(self.rows.max()) + margin + 1, int(self.columns.max()) + margin + 1
        return slice(top, min(bottom, shape[0])), slice(left, min(right, shape[1]))


def _motion(
    region: _Region,
    flow: Float32Array,
    first: UInt8Array,
    second: UInt8Array,
    labels: UInt8Array,
) -> _Motion | None:
    """One drone's motion, from where the flow says that it is or else from the best other start; None: not found."""
    flow_shift = np.median(flow[region.rows, region.columns], axis=0).astype(np.float64)
    template = _Template(region, first)
    near = _Window(template, second, flow_shift)
    best = _cubic(_affine(near), near)
    if best is None or best.correlation < _CERTAIN_CORRELATION:
        box = region.box(_SURROUNDINGS_PX, labels.shape)
        around = flow[box][labels[box] == 0]
        beside = np.median(around, axis=0).astype(np.float64) if len(around) else flow_shift
        starts = [beside, *_template_matches(region, first, second, beside)]
        windows = [_Window(template, second, start) for start in starts]
        aligned = [(motion, window) for window in windows if (motion := _affine(window))]
        other = _cubic(*max(aligned, key=lambda found: found[0].correlation)) if aligned else None
        if other and (best is None or other.correlation > best.correlation):
            best = other
    return best if best and best.correlation >= _MIN_CORRELATION else None


class _Template:
    """Some of a drone's pixels in the first image."""

    def __init__(self, region: _Region, first: UInt8Array) -> None:
        chosen = np.linspace(0, len(region.rows) - 1, min(len(region.rows), _MAX_PIXELS)).astype(np.int64)
        self.region = region
        rows, columns = region.rows[chosen].astype(np.float64), region.columns[chosen].astype(np.float64)
        self.places = np.stack([columns, rows])
        """(2, n) u and v."""
        middle = self.places.mean(1)
        size_px = max(6.0, 1.2 * float(np.hypot(columns - middle[0], rows - middle[1]).mean()))
        self.still = _Motion(middle, size_px, np.zeros((1, 2)))
        self.basis = np.ascontiguousarray(self.still.basis(rows, columns).T)
        """(10, n)"""
        box = region.box(4, first.shape)
        at = region.rows[chosen] - box[0].start, region.columns[chosen] - box[1].start
        self.colours = smoothed(first[box], 1.0)[at].astype(np.float64)
        grey_levels = grey(first[box]).astype(np.float32)
        self.layers = {}
        """For each stage's smoothing, (3, n): grey level, and how it changes to the right and down."""
        for stage in (_AFFINE_STAGE, *_HIGHER_ORDER_STAGES):
            layers = _with_gradients(smoothed(grey_levels, stage.sigma_px))
            self.layers[stage.sigma_px] = np.stack([layer[at] for layer in layers]).astype(np.float64)

    def moved(self, terms: FloatArray) -> FloatArray:
        """(2, n) u and v of the pixels when a motion of these terms (k, 2) has moved them."""
        moved: FloatArray = self.places + terms.T @ self.basis[: len(terms)]
        return moved


_POWERS = np.array([[0, 1, 0, 2, 1, 0, 3, 2, 1, 0], [0, 0, 1, 0, 1, 2, 0, 1, 2, 3]])
"""Of x and of y in each term of a motion."""


@dataclass(frozen=True, eq=False)
class _Motion:
    """Motion of a whole drone, as polynomials of a pixel's place."""

    middle: FloatArray
    """(2,) of the drone, u and v."""
    size_px: float
    terms: FloatArray
    """(1, 3, 6 or 10, 2) what each term adds right and down."""
    correlation: float = 0.0
    """Correlation of the drone's colours before and after."""

    def at(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """(n, 2) pixels right and down."""
        return self.basis(rows, columns)[:, : len(self.terms)] @ self.terms

    def basis(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """(n, 10) the terms' factors."""
        x, y = self._powers(rows, columns)
        return x[:, _POWERS[0]] * y[:, _POWERS[1]]

    def on_grid(self, rows: FloatArray, columns: FloatArray) -> FloatArray:
        """(2, h, w) pixels right and down where rows (h,) and columns (w,) cross: in a sixth of the time of `at`."""
        x, y = self._powers(rows, columns)
        factors = np.zeros((2, 4, 4))
        factors[:, _POWERS[1, : len(self.terms)], _POWERS[0, : len(self.terms)]] = self.terms.T
        found: FloatArray = y @ factors @ x.T
        return found

    def _powers(self, rows: FloatArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(w, 4) of x and (h, 4) of y, from the zeroth to the third."""
        x, y = (columns - self.middle[0]) / self.size_px, (rows - self.middle[1]) / self.size_px
        return np.vander(x, 4, increasing=True), np.vander(y, 4, increasing=True)


def _affine(window: _Window) -> _Motion | None:
    """The best affine motion near a window's shift; None where it leads out of the image."""
    return _aligned(replace(window.template.still, terms=window.shift[None]), window, (_AFFINE_STAGE,))


def _cubic(motion: _Motion | None, window: _Window) -> _Motion | None:
    """The best motion of third order near an affine one."""
    return _aligned(motion, window, _HIGHER_ORDER_STAGES) if motion else None


def _aligned(motion: _Motion, window: _Window, stages: tuple[AlignmentStage, ...]) -> _Motion | None:
    template = window.template
    for stage in stages:
        terms = np.zeros((stage.terms, 2))
        terms[: len(motion.terms)] = motion.terms[: stage.terms]
        found = stage.optimizer.minimise(_Alignment(window, stage), terms)
        if not found.equations.solvable:
            return None
        motion = replace(motion, terms=found.state)
    moved = template.moved(motion.terms)
    visible = window.inside(moved)
    correlation = _correlation(template.colours[visible], window.sample(window.colours, moved).T[visible])
    share = float(visible.mean()) ** _VISIBLE_EXPONENT
    return replace(motion, correlation=correlation * share)


class _Window:
    """The part of the second image where a drone may be, about a shift (2,) of it."""

    def __init__(self, template: _Template, second: UInt8Array, shift: FloatArray) -> None:
        self.template, self.shift = template, shift
        height, width = second.shape[:2]
        region = template.region
        extent = max(np.ptp(region.rows), np.ptp(region.columns))
        margin = _WINDOW_MARGIN_PX + int(extent) // 4
        u, v = round(float(shift[0])), round(float(shift[1]))
        left = int(np.clip(region.columns.min() + u - margin, 0, width - 2))
        top = int(np.clip(region.rows.min() + v - margin, 0, height - 2))
        right = int(np.clip(region.columns.max() + u + margin, left + 2, width))
        bottom = int(np.clip(region.rows.max() + v + margin, top + 2, height))
        rgb = second[top:bottom, left:right]
        self.colours, self._grey = smoothed(rgb, 1.0), grey(rgb).astype(np.float32)
        self._corner = np.array([[left], [top]], np.float64)
        self._farthest = np.array([[right - 1], [bottom - 1]], np.float64)

    def layers(self, sigma_px: float) -> Float32Array:
        """(h, w, 3) grey level, and how it changes to the right and down."""
        return np.asarray(cv2.merge(_with_gradients(smoothed(self._grey, sigma_px))), np.float32)

    def inside(self, places: FloatArray) -> BoolArray:
        """(n,) which of the whole image's (2, n) places are inside."""
        return np.asarray(((places >= self._corner) & (places <= self._farthest)).all(0))

    def sample(self, layers: Float32Array, places: FloatArray) -> FloatArray:
        """(3, n) at (2, n) places of the whole image."""
        u, v = (places - self._corner).astype(np.float32)[:, None]
        found = cv2.remap(layers, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found[0].T, dtype=np.float64, order="C")


class _Alignment(Problem[FloatArray]):
    """The template's grey levels less those of the second image where the motion's terms (k, 2) lead.

    A step is k numbers of u, k of v, then by how much brighter and richer in contrast the drone has become: those two
    are found anew each time.
    """

    def __init__(self, window: _Window, stage: AlignmentStage) -> None:
        self._window, self._basis = window, window.template.basis[: stage.terms]
        self._before, self._after = window.template.layers[stage.sigma_px], window.layers(stage.sigma_px)
        self._terms, pixels = self._basis.shape
        self._jacobian = np.ones((2 * self._terms + 2, pixels))
        """Transposed: what is computed in rows is fast."""
        self._jacobian[-1] = (self._before[0] - self._before[0].mean()) / 100.0  # about as large as the ones
        self._of_terms = self._jacobian[:-2].reshape(2, self._terms, pixels)
        self._term_damping = np.full(len(self._jacobian), _TERM_DAMPING)
        self._term_damping[[0, self._terms, -2]] = 0.0

    def linearise(self, state: FloatArray) -> NormalEquations:
        places = self._window.template.moved(state)
        visible = self._window.inside(places)
        if np.count_nonzero(visible) < _MIN_PIXELS:
            return NormalEquations.unsolvable(len(self._jacobian))
        there = self._window.sample(self._after, places)
        residuals = self._before[0] - there[0]
        residuals -= _median(residuals[visible])
        deviation = _median(np.abs(residuals[visible]))
        scale = max(_MIN_CAUCHY_LEVELS, _CAUCHY_DEVIATIONS * deviation)
        weights = visible * Cauchy(scale).weight(residuals**2)
        # Gradients of both images: converges from farther (Benhimane & Malis 2004).
        slope = (self._before[1:] + there[1:]) / -2
        np.multiply(slope[:, None], self._basis, out=self._of_terms)
        equations = NormalEquations.of(residuals, self._jacobian.T, weights)
        return equations.damped(self._damping(equations.hessian)) if equations.solvable else equations

    def move(self, state: FloatArray, step: FloatArray) -> FloatArray:
        moved: FloatArray = state + step[: 2 * self._terms].reshape(2, self._terms).T
        return moved

    def limited(self, step: FloatArray) -> FloatArray:
        shift = max(abs(float(step[0])), abs(float(step[self._terms])))
        return step * min(1.0, _MAX_STEP_PX / max(shift, 1e-9))

    def step_size(self, step: FloatArray) -> float:
        """Pixels."""
        return float(np.abs(step[: 2 * self._terms]).max())

    def _damping(self, hessian: FloatArray) -> FloatArray:
        of_shift = (hessian[0, 0] + hessian[self._terms, self._terms]) / 2
        damping: FloatArray = self._term_damping * of_shift
        damping += 1e-6 + 1e-10 * float(hessian.trace())  # stripes show motion one way only
        damping[-1] = _CONTRAST_DAMPING * self._basis.shape[1]
        return damping


def _template_matches(region: _Region, first: UInt8Array, second: UInt8Array, beside: FloatArray) -> list[FloatArray]:
    """Shifts to where something of a drone's colours is, the highest correlation first."""
    box = region.box(2, first.shape)
    coarse = 4 if max(box[0].stop - box[0].start, box[1].stop - box[1].start) > _SEARCH_RADIUS_PX else 2
    height, width = second.shape[0] // coarse, second.shape[1] // coarse
    rows, columns = np.minimum(region.rows // coarse, height - 1), np.minimum(region.columns // coarse, width - 1)
    top, left, bottom, right = int(rows.min()), int(columns.min()), int(rows.max()) + 1, int(columns.max()) + 1
    if bottom - top < 3 or right - left < 3:
        return []
    mask = np.zeros((bottom - top, right - left, 3), np.uint8)
    mask[rows - top, columns - left] = 1
    reach, (u, v) = _SEARCH_RADIUS_PX // coarse, np.round(beside / coarse).astype(int)
    beyond = (bottom - top) // 2, (right - left) // 2  # half of it may have left the image
    low = max(top + v - reach, -beyond[0]), max(left + u - reach, -beyond[1])
    high = min(bottom + v + reach, height + beyond[0]), min(right + u + reach, width + beyond[1])
    searched = _reduced(second, low, high, coarse)
    drone = _reduced(first, (top, left), (bottom, right), coarse)
    if searched is None or drone is None or any(np.less(searched.shape, drone.shape)):
        return []
    correlation = cv2.matchTemplate(searched, drone, cv2.TM_CCOEFF_NORMED, mask=mask)
    apart = max(2, min(mask.shape[:2]) // 3)
    peaks = _peaks(np.asarray(correlation, np.float32), apart, _MAX_MATCHES)
    return [coarse * np.array([low[1] + column - left, low[0] + row - top], np.float64) for row, column in peaks]


def _reduced(image: UInt8Array, low: tuple[int, int], high: tuple[int, int], times: int) -> UInt8Array | None:
    """An image so many ``times`` smaller: its rows and columns from ``low`` to ``high``, continued beyond its border.

    None where none is inside.
    """
    height, width = image.shape[0] // times, image.shape[1] // times
    top, left, bottom, right = max(low[0], 0), max(low[1], 0), min(high[0], height), min(high[1], width)
    if bottom <= top or right <= left:
        return None
    inside = image[times * top : times * bottom, times * left : times * right]
    small = cv2.resize(inside, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
    margins = top - low[0], high[0] - bottom, left - low[1], high[1] - right
    return np.asarray(cv2.copyMakeBorder(small, *margins, cv2.BORDER_REPLICATE), np.uint8)


def _peaks(correlation: Float32Array, apart: int, count: int) -> list[tuple[int, int]]:
    """Rows and columns of the highest positive values, more than ``apart`` from each other; at most ``count``."""
    remaining = np.where(np.isfinite(correlation), correlation, -1.0)
    least = max(float(remaining.max()) - _MATCH_MARGIN, 0.0)
    peaks: list[tuple[int, int]] = []
    for _ in range(count):
        row, column = (int(i) for i in np.unravel_index(int(remaining.argmax()), remaining.shape))
        if remaining[row, column] <= least:
            break
        peaks.append((row, column))
        remaining[max(row - apart, 0) : row + apart + 1, max(column - apart, 0) : column + apart + 1] = -1.0
    return peaks


def _residual_flow(region: _Region, first: UInt8Array, second: UInt8Array, motion: _Motion) -> FloatArray:
    """(n, 2) what each of its pixels moves apart from the whole drone, px."""
    box = region.box(5, first.shape)
    before, after = grey(first[box]), _warped_grey(box, second, motion)
    rows, columns = region.rows - box[0].start, region.columns - box[1].start
    inside_before, inside_after = before[rows, columns].astype(np.float32), after[rows, columns]
    apart = inside_after - inside_after.mean()
    contrast = min(max(float(apart @ inside_before) / max(float(apart @ apart), float(len(apart))), 0.5), 2.0)
    matched = np.clip(inside_before.mean() + contrast * (after - inside_after.mean()), 0, 255).astype(np.uint8)
    refinement = cv2.VariationalRefinement.create()
    refinement.setAlpha(_RESIDUAL_SMOOTHNESS)
    refinement.setGamma(_RESIDUAL_GRADIENTS)
    refinement.setFixedPointIterations(4)
    refinement.setSorIterations(10)
    residual = refinement.calc(before, matched, np.zeros((*before.shape, 2), np.float32))[rows, columns]
    length = np.linalg.norm(residual, axis=1, keepdims=True)
    limit = np.minimum(1.0, _MAX_RESIDUAL_PX / np.maximum(length, 1e-6))
    return np.asarray(residual * limit, np.float64)


def _warped_grey(box: tuple[slice, slice], second: UInt8Array, motion: _Motion) -> Float32Array:
    """(h, w) grey levels of the second image where the motion leads from a box of the first."""
    v, u = (np.arange(side.start, side.stop, dtype=np.float64) for side in box)
    reach = 2.5 * motion.size_px  # polynomials run wild far off
    near_u = np.clip(u, motion.middle[0] - reach, motion.middle[0] + reach)
    near_v = np.clip(v, motion.middle[1] - reach, motion.middle[1] + reach)
    by_u, by_v = motion.on_grid(near_v, near_u)
    to_u, to_v = (u + by_u).astype(np.float32), (v[:, None] + by_v).astype(np.float32)
    warped = cv2.remap(second, to_u, to_v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return grey(np.asarray(warped, np.uint8)).astype(np.float32)


def _with_gradients(image: Float32Array) -> tuple[Float32Array, Float32Array, Float32Array]:
    """The image, and how its grey levels change to the right and down."""
    right, down = (cv2.Sobel(image, cv2.CV_32F, *way, ksize=1, scale=1 / 2) for way in ((1, 0), (0, 1)))
    return image, np.asarray(right, np.float32), np.asarray(down, np.float32)


def _median(values: FloatArray) -> float:
    """The median, or of an even number the greater of the middle two: a third of the time of `np.median`."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])


def _correlation(a: FloatArray, b: FloatArray) -> float:
    """Correlation of (n, 3) colours, each channel about its own mean."""
    a, b = a - a.mean(0), b - b.mean(0)
    size = math.sqrt(float((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0 else -1.0

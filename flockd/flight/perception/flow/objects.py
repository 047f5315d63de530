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
_AFFINE_STAGE = AlignmentStage(2.0, 3, GaussNewton(max_steps=12, tolerance=0.1))
_HIGHER_ORDER_STAGES = (
    AlignmentStage(1.0, 6, GaussNewton(max_steps=10, tolerance=0.1)),
    AlignmentStage(0.6, 10, GaussNewton(max_steps=12, tolerance=0.1)),
)
_TERM_DAMPING = 0.005
"""Damping of all terms but the shift, in units of the shift's own curvature."""
_CONTRAST_DAMPING = 0.01
"""Damping of the change of contrast, a pixel."""
_MAX_STEP_PX = 3.0
"""Farther the linearised image is not the image."""
_WINDOW_MARGIN_PX = 24
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
    areas = cv2.calcHist([labels], [0], None, [256], [0.0, 256.0]).ravel()  # its shape depends on OpenCV
    areas[[0, UNCLASSED]] = 0
    large = np.flatnonzero(areas >= _MIN_PIXELS)
    found = flow.copy() if len(large) else flow
    for label in large:
        region = _Region(*np.nonzero(labels == label))
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
    best = _cubic(template, second, _affine(template, second, flow_shift))
    if best is None or best.correlation < _CERTAIN_CORRELATION:
        box = region.box(_SURROUNDINGS_PX, labels.shape)
        around = flow[box][labels[box] == 0]
        beside = np.median(around, axis=0).astype(np.float64) if len(around) else flow_shift
        starts = [beside, *_template_matches(region, first, second, beside)]
        aligned = [motion for start in starts if (motion := _affine(template, second, start))]
        most_alike = max(aligned, key=lambda motion: motion.correlation, default=None)
        other = _cubic(template, second, most_alike)
        if other and (best is None or other.correlation > best.correlation):
            best = other
    return best if best and best.correlation >= _MIN_CORRELATION else None


class _Template:
    """Some of a drone's pixels in the first image."""

    def __init__(self, region: _Region, first: UInt8Array) -> None:
        chosen = np.linspace(0, len(region.rows) - 1, min(len(region.rows), _MAX_PIXELS)).astype(np.int64)
        self.region = region
        self.rows, self.columns = region.rows[chosen].astype(np.float64), region.columns[chosen].astype(np.float64)
        self.middle = np.array([self.columns.mean(), self.rows.mean()])
        apart = np.hypot(self.columns - self.middle[0], self.rows - self.middle[1])
        self.size_px = max(6.0, 1.2 * float(apart.mean()))
        box = region.box(4, first.shape)
        at = region.rows[chosen] - box[0].start, region.columns[chosen] - box[1].start
        self.colours = smoothed(first[box], 1.0)[at].astype(np.float64)
        grey_levels = grey(first[box]).astype(np.float32)
        self.layers = {}
        """For each stage's smoothing, (n, 3): grey level, and how it changes to the right and down."""
        for stage in (_AFFINE_STAGE, *_HIGHER_ORDER_STAGES):
            layers = _with_gradients(smoothed(grey_levels, stage.sigma_px))
            self.layers[stage.sigma_px] = np.stack([layer[at] for layer in layers], 1).astype(np.float64)

    def moved(self, by: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u and v (n,) of the pixels when moved by (n, 2)."""
        return self.columns + by[:, 0], self.rows + by[:, 1]


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
        x, y = (columns - self.middle[0]) / self.size_px, (rows - self.middle[1]) / self.size_px
        xx, yy = x * x, y * y
        return np.stack([np.ones_like(x), x, y, xx, x * y, yy, xx * x, xx * y, x * yy, yy * y], 1)


def _affine(template: _Template, second: UInt8Array, start: FloatArray) -> _Motion | None:
    """The best affine motion near a shift (2,); None where it leads out of the image."""
    motion = _Motion(template.middle, template.size_px, start[None])
    return _aligned(template, second, motion, (_AFFINE_STAGE,))


def _cubic(template: _Template, second: UInt8Array, motion: _Motion | None) -> _Motion | None:
    """The best motion of third order near an affine one."""
    return _aligned(template, second, motion, _HIGHER_ORDER_STAGES) if motion else None


def _aligned(
    template: _Template, second: UInt8Array, motion: _Motion, stages: tuple[AlignmentStage, ...]
) -> _Motion | None:
    window = _Window(template, second, motion.terms[0])
    basis = motion.basis(template.rows, template.columns)
    for stage in stages:
        terms = np.zeros((stage.terms, 2))
        terms[: len(motion.terms)] = motion.terms[: stage.terms]
        found = stage.optimizer.minimise(_Alignment(template, window, basis[:, : stage.terms], stage), terms)
        if not found.equations.solvable:
            return None
        motion = replace(motion, terms=found.state)
    u, v = template.moved(motion.at(template.rows, template.columns))
    visible = window.inside(u, v)
    correlation = _correlation(template.colours[visible], window.sample(window.colours, u, v)[visible])
    share = float(visible.mean()) ** _VISIBLE_EXPONENT
    return replace(motion, correlation=correlation * share)


class _Window:
    """The part of the second image where a drone may be."""

    def __init__(self, template: _Template, second: UInt8Array, start: FloatArray) -> None:
        height, width = second.shape[:2]
        region = template.region
        extent = max(np.ptp(region.rows), np.ptp(region.columns))
        margin = _WINDOW_MARGIN_PX + int(extent) // 4
        u, v = round(float(start[0])), round(float(start[1]))
        self.left = int(np.clip(region.columns.min() + u - margin, 0, width - 2))
        self.top = int(np.clip(region.rows.min() + v - margin, 0, height - 2))
        right = int(np.clip(region.columns.max() + u + margin, self.left + 2, width))
        bottom = int(np.clip(region.rows.max() + v + margin, self.top + 2, height))
        rgb = second[self.top : bottom, self.left : right]
        self.colours, self._grey = smoothed(rgb, 1.0), grey(rgb).astype(np.float32)

    def layers(self, sigma_px: float) -> Float32Array:
        """(h, w, 3) grey level, and how it changes to the right and down."""
        return np.dstack(_with_gradients(smoothed(self._grey, sigma_px)))

    def inside(self, u: FloatArray, v: FloatArray) -> BoolArray:
        """Which pixels of the whole image are inside."""
        height, width = self._grey.shape
        u, v = u - self.left, v - self.top
        return np.asarray((u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1))

    def sample(self, layers: Float32Array, u: FloatArray, v: FloatArray) -> FloatArray:
        """(n, 3) at pixels of the whole image."""
        u32, v32 = (u - self.left).astype(np.float32)[:, None], (v - self.top).astype(np.float32)[:, None]
        found = cv2.remap(layers, u32, v32, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found[:, 0], dtype=np.float64)


class _Alignment(Problem[FloatArray]):
    """The template's grey levels less those of the second image where the motion's terms (k, 2) lead.

    A step is k numbers of u, k of v, then by how much brighter and richer in contrast the drone has become: those two
    are found anew each time.
    """

    def __init__(self, template: _Template, window: _Window, basis: FloatArray, stage: AlignmentStage) -> None:
        self._template, self._window, self._basis = template, window, basis
        self._before, self._after = template.layers[stage.sigma_px], window.layers(stage.sigma_px)
        self._terms = basis.shape[1]
        self._jacobian = np.ones((len(basis), 2 * self._terms + 2))
        self._jacobian[:, -1] = (self._before[:, 0] - self._before[:, 0].mean()) / 100.0  # about as large as the ones

    def linearise(self, state: FloatArray) -> NormalEquations:
        u, v = self._template.moved(self._basis @ state)
        visible = self._window.inside(u, v)
        if np.count_nonzero(visible) < _MIN_PIXELS:
            return NormalEquations.unsolvable(self._jacobian.shape[1])
        there = self._window.sample(self._after, u, v)
        residuals = self._before[:, 0] - there[:, 0]
        residuals -= _median(residuals[visible])
        deviation = _median(np.abs(residuals[visible]))
        scale = max(_MIN_CAUCHY_LEVELS, _CAUCHY_DEVIATIONS * deviation)
        weights = visible * Cauchy(scale).weight(residuals**2)
        # Gradients of both images: converges from farther (Benhimane & Malis 2004).
        slope = (self._before[:, 1:] + there[:, 1:]) / -2
        np.multiply(slope[:, :1], self._basis, out=self._jacobian[:, : self._terms])
        np.multiply(slope[:, 1:], self._basis, out=self._jacobian[:, self._terms : 2 * self._terms])
        equations = NormalEquations.of(residuals, self._jacobian, weights)
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
        damping = np.full(len(hessian), 1e-6 + 1e-10 * float(hessian.trace()))  # stripes show motion one way only
        of_shift = (hessian[0, 0] + hessian[self._terms, self._terms]) / 2
        for start in (0, self._terms):
            damping[start + 1 : start + self._terms] += _TERM_DAMPING * of_shift
        damping[-1] = _CONTRAST_DAMPING * len(self._basis)
        return damping


def _template_matches(region: _Region, first: UInt8Array, second: UInt8Array, beside: FloatArray) -> list[FloatArray]:
    """Shifts to where something of a drone's colours is, the highest correlation first."""
    box = region.box(2, first.shape)
    coarse = 4 if max(box[0].stop - box[0].start, box[1].stop - box[1].start) > _SEARCH_RADIUS_PX else 2
    rows, columns = region.rows // coarse, region.columns // coarse
    images = [cv2.resize(i, None, fx=1 / coarse, fy=1 / coarse, interpolation=cv2.INTER_AREA) for i in (first, second)]
    top, left = int(rows.min()), int(columns.min())
    bottom, right = min(int(rows.max()) + 1, len(images[0])), min(int(columns.max()) + 1, images[0].shape[1])
    if bottom - top < 3 or right - left < 3:
        return []
    mask = np.zeros((bottom - top, right - left, 3), np.uint8)
    mask[np.minimum(rows - top, bottom - top - 1), np.minimum(columns - left, right - left - 1)] = 1
    reach, (u, v) = _SEARCH_RADIUS_PX // coarse, np.round(beside / coarse).astype(int)
    height, width = images[1].shape[:2]
    beyond = (bottom - top) // 2, (right - left) // 2  # half of it may have left the image
    low = max(top + v - reach, -beyond[0]), max(left + u - reach, -beyond[1])
    high = min(bottom + v + reach, height + beyond[0]), min(right + u + reach, width + beyond[1])
    searched = _padded(np.asarray(images[1], np.uint8), low, high)
    if searched is None or min(high[0] - low[0] - (bottom - top), high[1] - low[1] - (right - left)) < 0:
        return []
    correlation = cv2.matchTemplate(searched, images[0][top:bottom, left:right], cv2.TM_CCOEFF_NORMED, mask=mask)
    apart = max(2, min(mask.shape[:2]) // 3)
    peaks = _peaks(np.asarray(correlation, np.float32), apart, _MAX_MATCHES)
    return [coarse * np.array([low[1] + column - left, low[0] + row - top], np.float64) for row, column in peaks]


def _padded(image: UInt8Array, low: tuple[int, int], high: tuple[int, int]) -> UInt8Array | None:
    """Rows and columns from ``low`` to ``high``, continued beyond the image's border; None where none is inside."""
    height, width = image.shape[:2]
    inside = image[max(low[0], 0) : min(high[0], height), max(low[1], 0) : min(high[1], width)]
    if not inside.size:
        return None
    margins = max(-low[0], 0), max(high[0] - height, 0), max(-low[1], 0), max(high[1] - width, 0)
    return np.asarray(cv2.copyMakeBorder(inside, *margins, cv2.BORDER_REPLICATE), np.uint8)


def _peaks(correlation: Float32Array, apart: int, count: int) -> list[tuple[int, int]]:
    """Rows and columns of the highest positive values, more than ``apart`` from each other; at most ``count``."""
    remaining = np.where(np.isfinite(correlation), correlation, -1.0)
    peaks: list[tuple[int, int]] = []
    for _ in range(count):
        row, column = (int(i) for i in np.unravel_index(int(remaining.argmax()), remaining.shape))
        if remaining[row, column] <= 0:
            break
        peaks.append((row, column))
        remaining[max(row - apart, 0) : row + apart + 1, max(column - apart, 0) : column + apart + 1] = -1.0
    return peaks


def _residual_flow(region: _Region, first: UInt8Array, second: UInt8Array, motion: _Motion) -> FloatArray:
    """(n, 2) what each of its pixels moves apart from the whole drone, px."""
    box = region.box(8, first.shape)
    before, after = grey(first[box]), _warped_grey(box, second, motion)
    rows, columns = region.rows - box[0].start, region.columns - box[1].start
    inside_before, inside_after = before[rows, columns].astype(np.float32), after[rows, columns]
    covariance = np.cov(inside_before, inside_after)[0, 1]
    contrast = float(np.clip(covariance / max(float(inside_after.var()), 1.0), 0.5, 2.0))
    matched = np.clip(inside_before.mean() + contrast * (after - inside_after.mean()), 0, 255).astype(np.uint8)
    refinement = cv2.VariationalRefinement.create()
    refinement.setAlpha(_RESIDUAL_SMOOTHNESS)
    refinement.setGamma(_RESIDUAL_GRADIENTS)
    refinement.setSorIterations(20)
    residual = refinement.calc(before, matched, np.zeros((*before.shape, 2), np.float32))[rows, columns]
    length = np.linalg.norm(residual, axis=1, keepdims=True)
    limit = np.minimum(1.0, _MAX_RESIDUAL_PX / np.maximum(length, 1e-6))
    return np.asarray(residual * limit, np.float64)


def _warped_grey(box: tuple[slice, slice], second: UInt8Array, motion: _Motion) -> Float32Array:
    """(h, w) grey levels of the second image where the motion leads from a box of the first."""
    v, u = np.mgrid[box].astype(np.float64)
    reach = 2.5 * motion.size_px  # polynomials run wild far off
    near_u = np.clip(u, motion.middle[0] - reach, motion.middle[0] + reach).ravel()
    near_v = np.clip(v, motion.middle[1] - reach, motion.middle[1] + reach).ravel()
    moved = motion.at(near_v, near_u).T.reshape(2, *u.shape).astype(np.float32)
    to_u, to_v = moved + np.stack([u, v]).astype(np.float32)
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

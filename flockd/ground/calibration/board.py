"""The ChArUco board: a chessboard with a marker in each white square, so that a part of it in view is enough; as it is
printed, found in images, and placed before a camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.errors import FlockdError
from flockd.core.messages import BoolArray, FloatArray, IntArray, UInt8Array
from flockd.flight.geometry import Camera, RigidTransform, rotation_from_vector


class CalibrationError(FlockdError):
    """Images or numbers do not suffice for a calibration, or contradict each other; the text says what to do."""


_DICTIONARY, _MARKERS, _MARKER_SHARE = cv2.aruco.DICT_4X4_50, 50, 0.75
"""ArUco markers of 4 by 4 cells, 50 of them; and the share of a square's side that a marker takes."""
MIN_CORNERS = 8
"""Least number of corners that determine the board's pose."""
CENTRE_PX = 0.5
"""OpenCV has pixel centres at whole numbers."""


@dataclass(frozen=True)
class BoardSpec:
    """A printed board. Raises CalibrationError for an impossible one."""

    columns: int = 7
    rows: int = 5
    """In squares."""
    square_m: float = 0.036
    """Side of a chessboard square."""
    legacy: bool = False
    """Whether OpenCV before 4.6 made it: with an even number of rows the first square then has a marker."""

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or max(self.columns, self.rows) > 50:
            raise CalibrationError(f"a board of {self.columns}x{self.rows} squares does not exist; take 3 to 50 a side")
        if not 0.001 <= self.square_m <= 1.0:
            raise CalibrationError(f"squares of {1e3 * self.square_m:g} mm are not printed; take 1 to 1000 mm")
        if self.corner_count < MIN_CORNERS:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} squares has too few corners; take 5x4 or more"
            )
        if (needed := self.columns * self.rows // 2) > _MARKERS:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} squares needs {needed} markers, and there are {_MARKERS}; take "
                "fewer squares"
            )

    @property
    def last_marker(self) -> int:
        """Number of the last marker; the first is 0."""
        return self.columns * self.rows // 2 - 1

    @property
    def corner_count(self) -> int:
        """Number of inner corners of the chessboard, which are detected in images."""
        return (self.columns - 1) * (self.rows - 1)

    def image(self, pixels_per_square: int) -> UInt8Array:
        """(h, w) grey: the board without any margin."""
        size = (self.columns * pixels_per_square, self.rows * pixels_per_square)
        return np.asarray(_opencv_board(self).generateImage(size, marginSize=0, borderBits=1), np.uint8)


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """The board's corners in one image."""

    ids: IntArray
    """(n,) numbers of the corners, row by row from the first corner of the board."""
    pixels: FloatArray
    """(n, 2) pixels with centres at +0.5."""
    points: FloatArray
    """(n, 3) metres on the board, z = 0."""


class BoardFinder:
    """Finds one board in images."""

    def __init__(self, spec: BoardSpec) -> None:
        self.spec = spec
        self._board = _opencv_board(spec)
        self._detector = cv2.aruco.CharucoDetector(self._board)
        self._without: UInt8Array | None = None
        """The last image in which there was no board."""

    def find(self, grey: UInt8Array) -> BoardDetection | None:
        """The board in an image (h, w); None: fewer than `MIN_CORNERS` corners are visible, or all are in one line."""
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < MIN_CORNERS:
            self._without = grey
            return None
        # The stubs want a list of images here, which would be wrong.
        points, pixels = self._board.matchImagePoints(corners, ids)  # type: ignore[call-overload]
        points = np.asarray(points, np.float64).reshape(-1, 3)
        if min(len(np.unique(points[:, 0].round(9))), len(np.unique(points[:, 1].round(9)))) < 2:
            return None
        pixels = np.asarray(pixels, np.float64).reshape(-1, 2) + CENTRE_PX
        return BoardDetection(np.asarray(ids, np.int64).reshape(-1), pixels, points)

    def found_instead(self) -> str:
        """What the last image without the board shows, for people."""
        if self._without is None:
            return "boards at an angle from which all their corners are in one line"
        spec, grey = self.spec, self._without
        made, swapped = "from" if spec.legacy else "before", f"{spec.rows}x{spec.columns}"
        for told, other, image in (
            (f"as OpenCV {made} 4.6 makes it, for which --legacy is", replace(spec, legacy=not spec.legacy), grey),
            (f"of {swapped} squares", replace(spec, columns=spec.rows, rows=spec.columns), grey),
            ("mirrored; let the camera not mirror its images", spec, np.ascontiguousarray(grey[:, ::-1])),
            ("with black and white exchanged; print it black on white", spec, 255 - grey),
        ):
            if BoardFinder(other).find(image) is not None:
                return f"the board {told}"
        counts = {}
        for name in sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")):
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
            found = cv2.aruco.ArucoDetector(dictionary).detectMarkers(self._without)[1]
            counts[name] = [] if found is None else np.ravel(found).tolist()
        name = max(counts, key=lambda name: len(counts[name]))
        if len(counts[name]) < _SOME_MARKERS:
            return "no markers"
        last = max(counts[name])
        told = f"{len(counts[name])} markers of {name.removeprefix('DICT_')}, the last of number {last}"
        return f"{told}; a board of {self.spec.columns}x{self.spec.rows} has {_OWN}, to number {self.spec.last_marker}"


_SOME_MARKERS, _OWN = 4, "4X4_50"
"""Fewer markers may be found by chance; and the name of the board's own dictionary."""


def _opencv_board(spec: BoardSpec) -> cv2.aruco.CharucoBoard:
    dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
    side_m = spec.square_m
    board = cv2.aruco.CharucoBoard((spec.columns, spec.rows), side_m, _MARKER_SHARE * side_m, dictionary)
    board.setLegacyPattern(spec.legacy)
    return board


_CELLS = 8
"""Across a square: its marker's six, and one beside it on either side."""
_MARGIN_MM, _RULER_MM = 12.0, 100.0


def page_mm(spec: BoardSpec) -> tuple[float, float]:
    """Width and height of the page: the board with a margin around it."""
    width, height = (1000.0 * spec.square_m * squares + 2 * _MARGIN_MM for squares in (spec.columns, spec.rows))
    return width, height


def board_svg(spec: BoardSpec) -> str:
    """One page: the board in its true size, its description, and a line to check the printer with."""
    width, height = page_mm(spec)
    cell_mm = 1000.0 * spec.square_m / _CELLS
    black = "".join(f"M{x} {y}h1v1h-1z" for y, x in np.argwhere(spec.image(_CELLS) == 0))
    text = f"{spec.columns}x{spec.rows} squares of {1000.0 * spec.square_m:g} mm. Print at 100 %; this line is "
    return f"""\
<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" viewBox="0 0 {width:g} {height:g}">
<rect width="100%" height="100%" fill="white"/>
<path transform="translate({_MARGIN_MM:g} {_MARGIN_MM:g}) scale({cell_mm:g})" shape-rendering="crispEdges" d="{black}"/>
<path transform="translate({_MARGIN_MM:g} {height - 4:g})" stroke="black" stroke-width="0.2" d="M0 0h{_RULER_MM:g}"/>
<text x="{_MARGIN_MM:g}" y="{height - 5:g}" font-family="sans-serif" font-size="2.5">{text}{_RULER_MM:g} mm long:</text>
</svg>
"""


_FACTOR = 2.5
MAX_DROPPED = 1 / 3
"""Share of all views that may be dropped; if more contradict the others, the right ones are not known."""


def inliers(rms_px: FloatArray, margin_px: float) -> BoolArray:
    """Mask (n,) of residuals (n,) that are inliers: within `_FACTOR` times the median, or ``margin_px`` above it."""
    median = float(np.median(rms_px))
    kept: BoolArray = rms_px <= max(_FACTOR * median, median + margin_px)
    return kept


def root_mean_square(residuals: FloatArray) -> float:
    """Root of the mean squared length of residuals (n, 2)."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


_NEAREST_ANGLE = 0.15
"""Cosine of the largest angle from the board's centre at which corners are used for the first pose."""


def residuals_px(camera: Camera, seen: BoardDetection, pose: RigidTransform) -> FloatArray:
    """(n, 2) pixels, measured minus predicted; ``pose``: ``T_camera_board``."""
    return seen.pixels - camera.project(pose.apply(seen.points))


def first_pose(camera: Camera, seen: BoardDetection) -> tuple[float, RigidTransform | None]:
    """``T_camera_board`` by IPPE, and its residual; None and infinity if no pose fits. Of the two poses that a flat
    board may have, it is the likelier one."""
    rays = camera.rays(seen.pixels)
    usable = np.isfinite(rays).all(axis=1)
    if not usable.any():
        return math.inf, None
    # Through a pinhole whose axis points straight at the board: so a lens may see the board beside or behind itself.
    R_virtual_camera = Rotation.align_vectors([[0.0, 0.0, 1.0]], [rays[usable].mean(axis=0)])[0].as_matrix()
    turned = rays @ R_virtual_camera.T
    usable &= turned[:, 2] > _NEAREST_ANGLE
    if usable.sum() < 4:
        return math.inf, None
    flat = turned[usable, :2] / turned[usable, 2:]
    try:
        _, turns, places, _ = cv2.solvePnPGeneric(
            seen.points[usable], flat, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # corners in one line
        return math.inf, None
    virtual = RigidTransform(R_virtual_camera.T, np.zeros(3))
    best: tuple[float, RigidTransform | None] = (math.inf, None)
    for start in zip(turns, places, strict=True):
        if np.isfinite(start).all():
            turn, place = cv2.solvePnPRefineLM(seen.points[usable], flat, np.eye(3), np.zeros(4), *start)
            pose = virtual @ RigidTransform(rotation_from_vector(np.ravel(turn)), np.ravel(place))
            error = root_mean_square(residuals_px(camera, seen, pose))
            if error < best[0]:
                best = error, pose
    return best

"""The ChArUco board: a chessboard with a marker in each white square, so that a part of it in view is enough; as it is
printed, found in images, and placed before a camera."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.errors import FlockdError
from flockd.core.messages import BoolArray, FloatArray, IntArray, UInt8Array
from flockd.flight.geometry import Camera, RigidTransform, rotation_from_vector


class CalibrationError(FlockdError):
    """What was shown is not enough, or does not fit together, for numbers anybody should fly with."""


_DICTIONARY, _MARKERS, _MARKER_SHARE = cv2.aruco.DICT_4X4_50, 50, 0.75
"""Markers of 4 by 4 cells, 50 of them, with so much of a square's side."""
MIN_CORNERS = 8
"""Fewer say too little of where the board is."""
_CENTRE_PX = 0.5
"""OpenCV has pixel centres at whole numbers."""


@dataclass(frozen=True)
class BoardSpec:
    """A board as it is printed. Raises CalibrationError for one that cannot be made."""

    columns: int = 7
    rows: int = 5
    """In squares."""
    square_m: float = 0.036
    """Side of a chessboard square."""

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or max(self.columns, self.rows) > 50:
            raise CalibrationError(f"a board of {self.columns}x{self.rows} squares is none; take 3 to 50 each way")
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
    def corner_count(self) -> int:
        """Inner corners of the chessboard: what is found in images."""
        return (self.columns - 1) * (self.rows - 1)

    def image(self, pixels_per_square: int) -> UInt8Array:
        """(h, w) grey: the board without any margin."""
        size = (self.columns * pixels_per_square, self.rows * pixels_per_square)
        return np.asarray(_opencv_board(self).generateImage(size, marginSize=0, borderBits=1), np.uint8)


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """The board's corners that are seen in one image."""

    ids: IntArray
    """(n,) their numbers, row by row from the first corner of the board."""
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

    def find(self, grey: UInt8Array) -> BoardDetection | None:
        """The board in a (h, w) image; None where fewer than `MIN_CORNERS` are seen, or all in one line."""
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        # The stubs want a list of images here, which would be wrong.
        points, pixels = self._board.matchImagePoints(corners, ids)  # type: ignore[call-overload]
        points = np.asarray(points, np.float64).reshape(-1, 3)
        if min(len(np.unique(points[:, 0].round(9))), len(np.unique(points[:, 1].round(9)))) < 2:
            return None
        pixels = np.asarray(pixels, np.float64).reshape(-1, 2) + _CENTRE_PX
        return BoardDetection(np.asarray(ids, np.int64).reshape(-1), pixels, points)


def _opencv_board(spec: BoardSpec) -> cv2.aruco.CharucoBoard:
    dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
    return cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_m, _MARKER_SHARE * spec.square_m, dictionary)


_PIXELS_PER_MM = 12
"""About 300 to the inch."""
_MARGIN_MM = 12.0
_POINTS_PER_MM = 72.0 / 25.4
_RULER_MM = 100.0
_LARGEST_PIXELS = 20_000


def board_pdf(spec: BoardSpec) -> bytes:
    """One page (ISO 32000-1): the board, what it is, and a line to check the printer with.

    Raises CalibrationError for a board that is too large to print.
    """
    pixels_per_square = round(spec.square_m * 1000.0 * _PIXELS_PER_MM)
    if not 8 <= pixels_per_square <= _LARGEST_PIXELS // max(spec.columns, spec.rows):
        raise CalibrationError(f"squares of {spec.square_m * 1000:g} mm cannot be printed; choose another size")
    image = spec.image(pixels_per_square)
    page_width, page_height = (side * _POINTS_PER_MM for side in page_mm(spec))
    width, height = (1000.0 * spec.square_m * squares * _POINTS_PER_MM for squares in (spec.columns, spec.rows))
    left, bottom = (page_width - width) / 2, (page_height - height) / 2
    ruler, low = _RULER_MM * _POINTS_PER_MM, bottom / 2
    text = (
        f"{spec.columns}x{spec.rows} squares of {spec.square_m * 1000:g} mm. Print at 100 %; this line is "
        f"{_RULER_MM:g} mm long:"
    )
    content = (
        f"q {width:.4f} 0 0 {height:.4f} {left:.4f} {bottom:.4f} cm /Board Do Q\n"
        f"BT /F 7 Tf {left:.4f} {low + 5:.4f} Td ({text}) Tj ET\n"
        f"0.5 w {left:.4f} {low:.4f} m {left + ruler:.4f} {low:.4f} l S\n"
    ).encode("ascii")
    objects = (
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {page_width:.4f} {page_height:.4f}] /Contents 4 0 R /Resources "
        "<< /XObject << /Board 5 0 R >> /Font << /F << /Type /Font /Subtype /Type1 /BaseFont /Helvetica >> >> >> "
        ">>".encode("ascii"),
        _stream("", content),
        _stream(
            f"/Type /XObject /Subtype /Image /Width {image.shape[1]} /Height {image.shape[0]} "
            "/ColorSpace /DeviceGray /BitsPerComponent 8 ",
            image.tobytes(),
        ),
    )
    data, places = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, start=1):
        places.append(len(data))
        data += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    head = b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    tail = b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, len(data))
    return data + head + table + tail


def page_mm(spec: BoardSpec) -> tuple[float, float]:
    """Width and height of the page: the board with a margin around it."""
    width, height = (1000.0 * spec.square_m * squares + 2 * _MARGIN_MM for squares in (spec.columns, spec.rows))
    return width, height


def _stream(entries: str, data: bytes) -> bytes:
    packed = zlib.compress(data, 9)
    head = f"<< {entries}/Filter /FlateDecode /Length {len(packed)} >>".encode("ascii")
    return head + b"\nstream\n" + packed + b"\nendstream"


_FACTOR = 2.5
MAX_DROPPED = 1 / 3
"""Share of all; where more contradict the others, it is not known which are right."""


def inliers(rms_px: FloatArray, margin_px: float) -> BoolArray:
    """Mask (n,) of residuals (n,) that are no outliers: within `_FACTOR` times the median, or ``margin_px`` above."""
    median = float(np.median(rms_px))
    kept: BoolArray = rms_px <= max(_FACTOR * median, median + margin_px)
    return kept


def root_mean_square(residuals: FloatArray) -> float:
    """Root of the mean squared length of residuals (n, 2)."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


_NEAREST_ANGLE = 0.15
"""Cosine of the largest angle from the board's middle at which a corner still helps to find a first pose."""


def residuals_px(camera: Camera, seen: BoardDetection, pose: RigidTransform) -> FloatArray:
    """(n, 2) pixels, seen less predicted; ``pose``: ``T_camera_board``."""
    return seen.pixels - camera.project(pose.apply(seen.points))


def first_pose(camera: Camera, seen: BoardDetection) -> tuple[float, RigidTransform | None]:
    """``T_camera_board`` by the board's outline (IPPE), after its residual; none, after infinity, where it fits none.

    Of the two that a flat board may have by its outline the likelier.
    """
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

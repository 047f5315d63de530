"""Where cameras sit beside each other, from a board that two or more of them see at the same time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.config import DroneConfig
from flockd.core.errors import ConfigError
from flockd.core.messages import UInt8Array
from flockd.flight.geometry import Camera, RigidTransform, rotation_angle_deg
from flockd.ground.calibration.board import (
    MAX_DROPPED,
    BoardDetection,
    BoardFinder,
    CalibrationError,
    first_pose,
    inliers,
    residuals_px,
    root_mean_square,
)
from flockd.ground.calibration.fragment import extrinsics_of, measured_today, write_rig
from flockd.ground.calibration.image_sources import ImageSet, ImageStream
from flockd.ground.calibration.views import edge_width_px, is_still, sharp_px

MIN_SHARED = 3
"""Boards that two neighbours have to see together."""
_MARGIN_PX = 0.5
_SIGMA_DEG, _SIGMA_M = 0.5, 0.02
"""A camera whose place the boards leave more uncertain than this is not known."""
_METRES_A_DEGREE = 0.01
"""How turns and shifts are weighed where only one number can be compared."""


@dataclass(frozen=True, eq=False)
class SharedBoard:
    """The board at one time, as seen by each camera that saw it."""

    name: str
    seen: Mapping[str, BoardDetection]


@dataclass(frozen=True, eq=False)
class Mounting:
    """Where one camera sits, and how sure that is."""

    T_body_camera: RigidTransform
    sigma_deg: float = 0.0
    """Standard deviation of its turn about the worst axis, by how much the boards differ; 0 of the reference."""
    sigma_m: float = 0.0
    """Standard deviation of its place along the worst axis, likewise."""
    rms_px: float = 0.0
    """Of the board's corners, where the neighbour's view of it says that they are."""
    boards: int = 0
    """Those that it shares with that neighbour."""
    dropped: tuple[tuple[str, float], ...] = ()
    """Names of boards that did not fit the others, with their residuals in pixels."""


def calibrate_rig(
    cameras: Mapping[str, Camera], boards: Sequence[SharedBoard], reference: str, T_body_reference: RigidTransform
) -> dict[str, Mounting]:
    """Places every camera in the body, by way of the neighbour with which it shares most boards.

    Raises CalibrationError where a camera shares too few boards with those that are linked to the reference, or where
    the boards contradict each other.
    """
    poses = [
        {name: pose for name, seen in board.seen.items() if (pose := first_pose(cameras[name], seen)[1]) is not None}
        for board in boards
    ]
    mountings = {reference: Mounting(T_body_reference)}
    while len(mountings) < len(cameras):
        count, known, new = max(
            (sum(known in found and new in found for found in poses), known, new)
            for known in mountings
            for new in cameras.keys() - mountings.keys()
        )
        if count < MIN_SHARED:
            others = ", ".join(mountings)
            raise CalibrationError(
                f"camera {new!r} shares {count} boards with {others}, and needs {MIN_SHARED}; show the board where "
                "both see it, and hold it still"
            )
        shared = [
            (board, found[known], found[new])
            for board, found in zip(boards, poses, strict=True)
            if known in found and new in found
        ]
        mountings[new] = _beside(mountings[known].T_body_camera, new, cameras[new], shared)
    return mountings


def _beside(
    T_body_known: RigidTransform,
    name: str,
    camera: Camera,
    shared: Sequence[tuple[SharedBoard, RigidTransform, RigidTransform]],
) -> Mounting:
    """``shared``: each board with its pose in the known camera and in the new one."""

    def residual_px(T_known_new: RigidTransform, board: SharedBoard, T_known_board: RigidTransform) -> float:
        return root_mean_square(residuals_px(camera, board.seen[name], T_known_new.inverse() @ T_known_board))

    steps = [T_known_board @ T_new_board.inverse() for _, T_known_board, T_new_board in shared]
    middle = min(steps, key=lambda one: sum(_distance(one, other) for other in steps))  # no outlier moves it
    rms_px = np.array([residual_px(middle, board, T_known_board) for board, T_known_board, _ in shared])
    fits = inliers(rms_px, _MARGIN_PX)
    dropped = tuple((shared[k][0].name, float(rms_px[k])) for k in np.flatnonzero(~fits).tolist())
    kept = np.flatnonzero(fits).tolist()
    if len(dropped) > MAX_DROPPED * len(shared) or len(kept) < MIN_SHARED:
        raise CalibrationError(
            f"{len(dropped)} of {len(shared)} boards contradict the others; hold the board still, let every camera "
            "take its image at the same time, and check the cameras' intrinsics"
        )
    turns = Rotation.from_matrix([steps[k].rotation for k in kept])
    places = np.array([steps[k].translation for k in kept])
    mean = RigidTransform(turns.mean().as_matrix(), places.mean(axis=0))
    apart_deg = np.degrees((turns.mean().inv() * turns).as_rotvec())
    spread = np.sqrt(len(kept) * (len(kept) - 1))  # of a mean
    sigma_deg = float(np.linalg.norm(apart_deg, axis=0).max() / spread)
    sigma_m = float(np.linalg.norm(places - places.mean(axis=0), axis=0).max() / spread)
    if not (sigma_deg < _SIGMA_DEG and sigma_m < _SIGMA_M):
        raise CalibrationError(
            f"the boards leave the place of camera {name!r} uncertain by {sigma_deg:.2g} degrees and "
            f"{100 * sigma_m:.2g} cm; show the board nearer, tilted, and in more places that both see"
        )
    left_px = [residual_px(mean, shared[k][0], shared[k][1]) for k in kept]
    return Mounting(
        T_body_known @ mean, sigma_deg, sigma_m, float(np.sqrt(np.mean(np.square(left_px)))), len(kept), dropped
    )


def _distance(a: RigidTransform, b: RigidTransform) -> float:
    turn = rotation_angle_deg(a.rotation.T @ b.rotation)
    return turn * _METRES_A_DEGREE + float(np.linalg.norm(a.translation - b.translation))


class SharedCollector:
    """Takes sets of images one after the other."""

    def __init__(self, finder: BoardFinder) -> None:
        self._finder = finder
        self._before: Mapping[str, tuple[BoardDetection, int]] = {}
        self.boards: list[SharedBoard] = []

    def offer(self, name: str, greys: Mapping[str, UInt8Array], *, moving: bool) -> None:
        """Takes the (h, w) images of one time. ``moving``: sets follow each other so fast that motion shows."""
        seen: dict[str, tuple[BoardDetection, int]] = {}
        for camera, grey in greys.items():
            board, width = self._finder.find(grey), grey.shape[1]
            if board is not None and not edge_width_px(grey, board, self._finder.spec) > sharp_px(width):
                seen[camera] = board, width
        before, self._before = self._before, seen
        still = {
            camera: board
            for camera, (board, width) in seen.items()
            if not moving or (camera in before and is_still(before[camera][0], board, width))
        }
        if len(still) > 1:
            self.boards.append(SharedBoard(name, still))

    def links(self) -> Mapping[tuple[str, ...], int]:
        """How many boards these cameras saw together, and no other with them."""
        return Counter(tuple(sorted(board.seen)) for board in self.boards)


def collect_boards(
    images: ImageStream,
    config: DroneConfig,
    where: str,
    collector: SharedCollector,
    on_image: Callable[[int, int], None],
    on_links: Callable[[str], None],
) -> None:
    """Gives the collector all images of a drone's cameras; ``where``: the file of its configuration.

    ``on_image`` is called with the number of sets done and the number there are; ``on_links``, live only, with who saw
    boards together, as that changes. Raises ConfigError for an image of another size than its camera's.
    """
    reported = ""
    for number, one in enumerate(images.sets, start=1):
        collector.offer(one.name, _greys(one, config, where), moving=images.live)
        on_image(number, images.count or number)
        links = "; ".join(f"{' and '.join(names)} saw {count}" for names, count in collector.links().items())
        if images.live and links != reported:
            on_links(links)
            reported = links


def _greys(one: ImageSet, config: DroneConfig, where: str) -> dict[str, UInt8Array]:
    """By camera, (h, w)."""
    greys = {}
    for camera in config.rig.cameras:
        if camera.name in one.images:
            image = one.images[camera.name]
            if image.shape[1::-1] != camera.size_px:
                width, height = camera.size_px
                message = (
                    f"of camera {camera.name!r} is {width} x {height}, and its image {one.name} has "
                    f"{image.shape[1]} x {image.shape[0]} pixels; calibrate the lens for that size"
                )
                raise ConfigError.at(where, message, "rig.cameras: size_px")
            greys[camera.name] = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    return greys


def write_fit(
    mountings: Mapping[str, Mounting],
    config: DroneConfig,
    where: str,
    source: str,
    identities: Mapping[str, str],
    out: Path,
) -> dict[str, Any]:
    """Writes the mountings, the reference's first, to ``out`` and gives the result; ``source``: of the images."""
    reference = next(iter(mountings))
    cameras, results = [], {}
    for camera in config.rig.cameras:
        mounting, extrinsics = mountings[camera.name], camera.extrinsics
        if camera.name != reference:
            known = camera.intrinsics.measured
            measured = measured_today(
                camera=known.camera if known else identities.get(camera.name, camera.name),
                source=f"{source}, against {reference}",
                views=mounting.boards,
                residual_px=round(mounting.rms_px, 4),
            )
            extrinsics = extrinsics_of(mounting.T_body_camera, measured)
        cameras.append(camera.model_copy(update={"extrinsics": extrinsics}))
        results[camera.name] = {
            **extrinsics.model_dump(mode="json", exclude={"measured"}),
            "sigma_deg": mounting.sigma_deg,
            "sigma_m": mounting.sigma_m,
            "residual_px": mounting.rms_px,
            "boards": mounting.boards,
        }
    note = (
        f"{reference} sits where {where} says, and the others beside it: a board cannot determine where in the "
        "body that is, but `--from-flight` tells how it is turned"
    )
    write_rig(out, cameras, config.rig.time_offset_s)
    return {
        "by": "board",
        "reference": reference,
        "dropped": dict(one for mounting in mountings.values() for one in mounting.dropped),
        "cameras": results,
        "time_offset_s": None,
        "notes": [note],
        "out": str(out),
    }

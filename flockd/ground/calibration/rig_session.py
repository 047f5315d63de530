"""A rig by boards that cameras see together: boards collected, the result as a file and as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.config.rig import CameraConfig
from flockd.core.errors import ConfigError
from flockd.core.messages import UInt8Array
from flockd.ground.calibration.board import BoardDetection, BoardFinder
from flockd.ground.calibration.extrinsics import Mounting, SharedBoard
from flockd.ground.calibration.fragment import extrinsics_of, measured_today, rig_text
from flockd.ground.calibration.image_sources import ImageSet, ImageStream
from flockd.ground.calibration.views import edge_width_px, is_still, sharp_px
from flockd.onboard.recording.editing import written_whole


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


def write_rig(out: Path, cameras: Sequence[CameraConfig], time_offset_s: float) -> None:
    """A file with a rig section, in place of any that was there."""
    comment = (
        "The cameras of a drone, written by `flockd calibrate rig`. Put this in place of `rig` in your drone's file,",
        "then run `flockd config check` on that.",
    )
    with written_whole(out) as draft:
        draft.write_text(rig_text(cameras, comment, time_offset_s), encoding="utf-8")

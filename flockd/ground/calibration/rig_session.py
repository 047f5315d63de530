"""A rig from start to end, by boards that cameras see together: the result as a file and as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.config.rig import CameraConfig
from flockd.core.errors import ConfigError
from flockd.core.messages import UInt8Array
from flockd.flight.geometry import build_rig
from flockd.ground.calibration.board import BoardDetection, BoardFinder
from flockd.ground.calibration.extrinsics import RigFit, SharedBoard, calibrate_rig
from flockd.ground.calibration.fragment import extrinsics_of, measured_today, rig_text
from flockd.ground.calibration.image_sources import ImageSet, ImageStream
from flockd.ground.calibration.views import edge_width_px, is_still, sharp_px
from flockd.onboard.recording.editing import written_whole

OnImage = Callable[[int, int], None]
"""Called with the number of sets of images done, and the number there are."""


@dataclass(frozen=True, eq=False)
class RigSession:
    """A drone whose cameras are calibrated, and their images."""

    config: DroneConfig
    where: str
    """The file that the configuration came from."""
    source: str
    """Where the images came from."""
    images: ImageStream

    def collect_boards(self, collector: SharedCollector, on_image: OnImage, on_links: Callable[[str], None]) -> None:
        """Gives the collector every image; ``on_links``, live only, with who saw boards together, as that changes."""
        reported = ""
        for number, one in enumerate(self.images.sets, start=1):
            collector.offer(one.name, self._greys(one), moving=self.images.live)
            on_image(number, self.images.count or number)
            links = "; ".join(f"{' and '.join(names)} saw {count}" for names, count in collector.links().items())
            if self.images.live and links != reported:
                on_links(links)
                reported = links

    def by_board(self, boards: Sequence[SharedBoard], reference: str, out: Path) -> dict[str, Any]:
        """Fits where the cameras sit beside ``reference``, writes it to ``out`` and gives the result.

        Raises CalibrationError where the boards do not determine it.
        """
        rig = build_rig(self.config.rig).cameras
        cameras = {name: one.camera for name, one in rig.items()}
        fit = calibrate_rig(cameras, boards, reference, rig[reference].T_body_camera)
        return self._result_by_board(fit, out)

    def _greys(self, one: ImageSet) -> dict[str, UInt8Array]:
        """By camera, (h, w). Raises ConfigError for an image of another size than the camera's."""
        greys = {}
        for camera in self.config.rig.cameras:
            if camera.name in one.images:
                image = one.images[camera.name]
                if image.shape[1::-1] != camera.size_px:
                    width, height = camera.size_px
                    message = (
                        f"of camera {camera.name!r} is {width} x {height}, and its image {one.name} has "
                        f"{image.shape[1]} x {image.shape[0]} pixels; calibrate the lens for that size"
                    )
                    raise ConfigError.at(self.where, message, "rig.cameras: size_px")
                greys[camera.name] = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        return greys

    def _result_by_board(self, fit: RigFit, out: Path) -> dict[str, Any]:
        cameras, results = [], {}
        for camera in self.config.rig.cameras:
            mounting = fit.mountings[camera.name]
            extrinsics = camera.extrinsics
            if camera.name != fit.reference:
                measured = measured_today(
                    camera=self._identity(camera),
                    source=f"{self.source}, against {fit.reference}",
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
        notes = [
            f"{fit.reference} sits where {self.where} says, and the others beside it: a board cannot determine where "
            "in the body that is, but `--from-flight` tells how it is turned"
        ]
        write_rig(out, cameras, self.config.rig.time_offset_s)
        return {
            "by": "board",
            "reference": fit.reference,
            "residual_px": fit.rms_px,
            "dropped": dict(fit.dropped),
            "cameras": results,
            "time_offset_s": None,
            "notes": notes,
            "out": str(out),
        }

    def _identity(self, camera: CameraConfig) -> str:
        measured = camera.intrinsics.measured
        return measured.camera if measured else self.images.identities.get(camera.name, camera.name)


def write_rig(out: Path, cameras: Sequence[CameraConfig], time_offset_s: float) -> None:
    """A file with a rig section, in place of any that was there."""
    comment = (
        "The cameras of a drone, written by `flockd calibrate rig`. Put this in place of `rig` in your drone's file,",
        "then run `flockd config check` on that.",
    )
    with written_whole(out) as draft:
        draft.write_text(rig_text(cameras, comment, time_offset_s), encoding="utf-8")


class SharedCollector:
    """Takes sets of images one after the other."""

    def __init__(self, finder: BoardFinder) -> None:
        self._finder = finder
        self._before: Mapping[str, tuple[BoardDetection, int]] = {}
        self.boards: list[SharedBoard] = []

    def offer(self, name: str, greys: Mapping[str, UInt8Array], *, moving: bool) -> None:
        """Takes the (h, w) images of one time. ``moving``: sets follow each other so fast that motion shows."""
        found = {camera: (self._finder.find(grey), grey) for camera, grey in greys.items()}
        seen = {
            camera: (board, grey.shape[1])
            for camera, (board, grey) in found.items()
            if board is not None and not edge_width_px(grey, board, self._finder.spec) > sharp_px(grey.shape[1])
        }
        before, self._before = self._before, seen
        if moving:
            seen = {
                camera: (board, width)
                for camera, (board, width) in seen.items()
                if camera in before and is_still(before[camera][0], board, width)
            }
        if len(seen) > 1:
            self.boards.append(SharedBoard(name, {camera: board for camera, (board, _) in seen.items()}))

    def links(self) -> Mapping[tuple[str, ...], int]:
        """How many boards these cameras saw together, and no other with them."""
        return Counter(tuple(sorted(board.seen)) for board in self.boards)

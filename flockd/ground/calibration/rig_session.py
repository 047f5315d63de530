"""A rig from start to end: by boards that cameras see together, or by motion; the result as a file and as JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.config.rig import CameraConfig
from flockd.core.errors import ConfigError
from flockd.core.messages import UInt8Array, VehicleState
from flockd.flight.geometry import RigidTransform, build_rig
from flockd.ground.calibration.alignment import Alignment, Attitudes, align
from flockd.ground.calibration.errors import CalibrationError
from flockd.ground.calibration.extrinsics import RigFit, SharedBoard, calibrate_rig
from flockd.ground.calibration.fragment import extrinsics_of, measured_today, rig_text
from flockd.ground.calibration.image_sources import ImageSet, ImageStream
from flockd.ground.calibration.shared import SharedCollector
from flockd.ground.calibration.turns import Follower
from flockd.onboard.recording.editing import written_whole

OnImage = Callable[[int, int], None]
"""Called with the number of sets of images done, and the number there are."""

_APART_S, _APART_SIGMAS = 5e-3, 4.0
"""The time of one camera is reported where it differs from the rig's by more than noise, and by more than matters: at
the 2 rad/s of a brisk turn five milliseconds are 0.6 degrees."""


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

    def align_cameras(self, max_offset_s: float, on_image: OnImage) -> dict[str, Alignment]:
        """How each camera is turned in the body, and its time, by the turns it saw and the autopilot's attitude.

        The images have to come with the vehicle's state, as a recording's do. Raises CalibrationError.
        """
        rig = build_rig(self.config.rig).cameras
        followers = {name: Follower(one.camera, one.T_body_camera.rotation) for name, one in rig.items()}
        states: list[VehicleState] = []
        for number, one in enumerate(self.images.sets, start=1):
            assert one.vehicle is not None
            if not states or one.vehicle.time_s > states[-1].time_s:
                states.append(one.vehicle)
            for name, grey in self._greys(one).items():
                followers[name].add(one.times_s[name], grey, one.vehicle.R_ned_body)
            on_image(number, self.images.count)
        attitudes = Attitudes(
            np.array([state.time_s for state in states]), np.array([state.R_ned_body for state in states])
        )
        return {name: self._aligned(name, one, attitudes, max_offset_s) for name, one in followers.items()}

    def by_motion(self, alignments: Mapping[str, Alignment], out: Path) -> dict[str, Any]:
        """Writes the turned cameras and the rig's time offset to ``out`` and gives the result."""
        rig = build_rig(self.config.rig)
        offset_s = _weighted_offset_s(alignments)
        cameras, results = [], {}
        for camera in self.config.rig.cameras:
            one = alignments[camera.name]
            measured = measured_today(
                camera=self._identity(camera),
                source=f"{self.source}, by motion",
                views=one.turns,
                residual_deg=round(one.rms_deg, 4),
            )
            T_body_camera = RigidTransform(one.R_body_camera, rig.cameras[camera.name].T_body_camera.translation)
            extrinsics = extrinsics_of(T_body_camera, measured)
            cameras.append(camera.model_copy(update={"extrinsics": extrinsics}))
            results[camera.name] = {
                **extrinsics.model_dump(mode="json", exclude={"measured"}),
                "sigma_deg": one.sigma_deg,
                "residual_deg": one.rms_deg,
                "turns": one.turns,
                "time_offset_s": one.time_offset_s,
                "sigma_s": one.sigma_s,
            }
        notes = [
            "position_m is kept from the configuration: attitude says nothing of where a camera sits; measure it, or "
            "show neighbouring cameras a board",
            *_notes_on_time(alignments, offset_s),
        ]
        write_rig(out, cameras, round(offset_s, 4))
        return {
            "by": "motion",
            "reference": None,
            "cameras": results,
            "time_offset_s": offset_s,
            "notes": notes,
            "out": str(out),
        }

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

    def _aligned(self, name: str, follower: Follower, attitudes: Attitudes, max_offset_s: float) -> Alignment:
        try:
            return align(follower.turns, attitudes, max_offset_s)
        except CalibrationError as error:
            lost = ", ".join(f"{reason}: {count} times" for reason, count in follower.lost.items())
            raise CalibrationError(
                f"{self.source}: camera {name!r}: {error}" + (f" (not followed: {lost})" if lost else "")
            ) from None

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
            "in the body that is, but `--by motion` determines how it is turned"
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


def _weighted_offset_s(alignments: Mapping[str, Alignment]) -> float:
    """The mean of the cameras' offsets, weighted by their inverse variances."""
    offset_s = sum(one.time_offset_s / one.sigma_s**2 for one in alignments.values())
    return offset_s / sum(1.0 / one.sigma_s**2 for one in alignments.values())


def _notes_on_time(alignments: Mapping[str, Alignment], offset_s: float) -> list[str]:
    worst = max(alignments, key=lambda name: abs(alignments[name].time_offset_s - offset_s))
    apart_s = abs(alignments[worst].time_offset_s - offset_s)
    if apart_s <= max(_APART_S, _APART_SIGMAS * alignments[worst].sigma_s):
        return []
    return [f"the time of camera {worst!r} is {1000 * apart_s:.0f} ms off the others'; the offset is their mean"]


def write_rig(out: Path, cameras: Sequence[CameraConfig], time_offset_s: float) -> None:
    """A file with a rig section, in place of any that was there."""
    comment = (
        "The cameras of a drone, written by `flockd calibrate rig`. Put this in place of `rig` in your drone's file,",
        "then run `flockd config check` on that.",
    )
    with written_whole(out) as draft:
        draft.write_text(rig_text(cameras, comment, time_offset_s), encoding="utf-8")

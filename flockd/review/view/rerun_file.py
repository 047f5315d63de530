"""The adapter to Rerun for one recording: writes a recording's scenes to a file, and opens its viewer on one.

Neither does anything beyond this computer: the viewer listens on the loopback interface alone, its usage statistics are
off, and what it would ask the web for (whether it is the newest) ends at a closed port.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from flockd.core.messages import Float32Array, PilotOutput, UInt8Array
from flockd.flight.geometry import PinholeCamera, Rig, RigCamera
from flockd.review.view.scene import Maps, Moment

_NOBODY = "http://127.0.0.1:9"
_ENVIRONMENT = {
    "CI": "1",  # Rerun collects no usage statistics where this is set; its own switch would be for all its users' files
    "RERUN_APP_ONLY": "true",  # no welcome that speaks of collecting them
    **dict.fromkeys(("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "http_proxy", "https_proxy", "all_proxy"), _NOBODY),
    "RUST_LOG": "error",
}
_FORCES_STATISTICS = "FORCE_RERUN_ANALYTICS"

_BODY, _TIMELINE = "world/drone", "time"
_HERE = "world/here"
"""Where the drone is, with north where it always is: what the 3D views look at."""
_DEPTH_UNITS_A_METRE = 100.0
_FARTHEST_M = 75.0
_JPEG_QUALITY = 90
_OWN, _COMMAND, _WANTED, _STILL, _REJECTED = (0, 114, 178), (213, 94, 0), (230, 159, 0), (120, 130, 145), (200, 60, 60)
_TRUE = (0, 158, 115)
_DRONES = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167), (213, 94, 0))
_DRONE_RADIUS_M = 0.3


class RerunWriter:
    """One `.rrd` file, in metres north, east and down. Raises OSError where that cannot be."""

    def __init__(self, path: Path, name: str, blueprint: Any) -> None:
        path.open("wb").close()  # Rerun's own writer reports a failure only in its log
        self.recording = rr.RecordingStream("flockd", recording_id=f"flockd-{name}")
        self.recording.save(path, default_blueprint=blueprint)
        self.recording.send_recording_name(name)
        self.recording.set_log_time_enabled(False)  # when the file was written is of no interest
        self.recording.set_log_tick_enabled(False)
        self.log("world", rr.ViewCoordinates.FRD, static=True)  # as north, east and down lie to each other

    def at(self, time_s: float, step: int | None = None) -> None:
        """What follows is of this time; ``step``: its number, or None for what is of no step."""
        self.recording.reset_time()
        self.recording.set_time(_TIMELINE, duration=time_s)
        if step is not None:
            self.recording.set_time("step", sequence=step)

    def log(self, entity: str, what: Any, *, static: bool = False) -> None:
        """Adds something."""
        self.recording.log(entity, what, static=static)

    def close(self) -> None:
        """Ends the file."""
        self.recording.flush()
        self.recording.disconnect()


class RerunFile:
    """Writes one `.rrd` file of one drone. Raises OSError where that cannot be."""

    def __init__(self, path: Path, drone: str, rig: Rig) -> None:
        self._rig = rig
        self._track: list[list[float]] = []
        self._file = RerunWriter(path, drone, _blueprint(rig))
        self._log = self._file.log
        for camera in rig.cameras.values():
            self._mount(camera)

    def show(self, moment: Moment) -> None:
        """Adds one step."""
        self._file.at(moment.time_s, moment.number)
        place = moment.place
        self._track.append(place.position.tolist())
        self._log(_HERE, rr.Transform3D(translation=place.position))
        self._log(_BODY, rr.Transform3D(translation=place.position, mat3x3=place.R_ned_body))
        for name, image in moment.images.items():
            if name in self._rig.cameras:
                self._log(f"{_BODY}/{name}/image", rr.EncodedImage(contents=jpeg(image), media_type="image/jpeg"))
        if moment.maps is not None:
            self._show_maps(moment.maps)
        names, positions = list(moment.true_neighbours), list(moment.true_neighbours.values())
        if names:
            sizes = [[_DRONE_RADIUS_M] * 3] * len(names)
            boxes = rr.Boxes3D(centers=positions, half_sizes=sizes, labels=names, colors=[_TRUE] * len(names))
            self._log("world/truth", boxes)
        self._curve("height_m", moment.height_m)
        if moment.output is not None:
            self._show_output(moment.output, moment)

    def say(self, time_s: float, text: str) -> None:
        """Adds a text event."""
        self._file.at(time_s)
        self._log("log", rr.TextLog(text, level="INFO"))

    def close(self) -> None:
        """Ends the file."""
        self._log("world/path", rr.LineStrips3D([self._track], colors=[_OWN]), static=True)
        self._file.close()

    def _mount(self, camera: RigCamera) -> None:
        """Where a camera sits; a wide-angle one has no image plane in 3D, and lens distortion is left as it is."""
        entity, T = f"{_BODY}/{camera.name}", camera.T_body_camera
        self._log(entity, rr.Transform3D(translation=T.translation, mat3x3=T.rotation), static=True)
        if isinstance(camera.camera, PinholeCamera):
            pinhole = rr.Pinhole(
                image_from_camera=camera.camera.matrix,
                resolution=camera.camera.size,
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.5,
            )
            self._log(entity, pinhole, static=True)
        classes = [rr.AnnotationInfo(0, "background", (0, 0, 0, 0)), rr.AnnotationInfo(255, "not used", (90, 90, 90))]
        classes += [rr.AnnotationInfo(label, f"drone {label}", colour_of(label)) for label in range(1, 255)]
        self._log(entity, rr.AnnotationContext(classes), static=True)

    def _show_maps(self, maps: Maps) -> None:
        for name, labels in maps.labels.items():
            self._log(f"{_BODY}/{name}/labels", rr.SegmentationImage(labels, opacity=0.6, draw_order=1.0))
        for name, depth in maps.depth.items():
            depth_image = rr.EncodedDepthImage(
                _depth_png(depth), media_type="image/png", meter=_DEPTH_UNITS_A_METRE, depth_range=(0.0, 2000.0)
            )
            self._log(f"{_BODY}/{name}/depth", depth_image)
        for kind in ("still", "rejected"):
            lines = maps.pairs.get(kind, np.zeros((0, 2, 3)))
            colour = _STILL if kind == "still" else _REJECTED
            self._log(f"world/pairs/{kind}", rr.LineStrips3D(lines, colors=[colour] * len(lines), radii=0.008))
        moving = {kind: lines for kind, lines in maps.pairs.items() if kind.startswith("drone")}
        lines = np.concatenate([*moving.values(), np.zeros((0, 2, 3))])
        colours = [colour_of(int(kind.split()[1])) for kind, several in moving.items() for _ in several]
        self._log("world/pairs/drones", rr.LineStrips3D(lines, colors=colours, radii=0.012))

    def _show_output(self, output: PilotOutput, moment: Moment) -> None:
        here = moment.place.position
        neighbours = output.neighbours
        centres = [here + neighbour.position for neighbour in neighbours]
        colours = [colour_of(neighbour.track) for neighbour in neighbours]
        ranges = [float(np.linalg.norm(neighbour.position)) for neighbour in neighbours]
        labels = [
            f"#{n.track} {range_m:.2f} m{'' if n.confirmed else ' ?'}"
            for n, range_m in zip(neighbours, ranges, strict=True)
        ]
        radii = [max(neighbour.position_sigma_m, 0.05) for neighbour in neighbours]
        self._log("world/neighbours", rr.Points3D(centres, radii=radii, colors=colours, labels=labels))
        motions = rr.Arrows3D(origins=centres, vectors=[n.velocity for n in neighbours], colors=colours, radii=0.03)
        self._log("world/neighbours/velocity", motions)
        self._show_command(output, moment)
        for neighbour, range_m in zip(neighbours, ranges, strict=True):
            self._curve(f"neighbours_m/track_{neighbour.track}", range_m)
        if output.ego_motion is not None:
            self._curve("own_motion/inlier_ratio", output.ego_motion.inliers / output.ego_motion.pairs)
        for stage, ms in output.stages_ms.items():
            self._curve(f"stages_ms/{stage}", ms)
        for reason in output.reasons:
            self._log("log", rr.TextLog(reason.text, level="WARN"))

    def _show_command(self, output: PilotOutput, moment: Moment) -> None:
        here = moment.place.position
        command = output.command
        arrows = {
            "world/command/velocity": ([*command.velocity, 0.0], _COMMAND),
            "world/command/acceleration": ([*command.acceleration, 0.0], _WANTED),
        }
        velocities = {"commanded": command.velocity}
        if output.velocity is not None:
            arrows["world/own_velocity"] = (output.velocity.tolist(), _OWN)
            velocities["own"] = output.velocity[:2]
        for entity, (vector, colour) in arrows.items():
            self._log(entity, rr.Arrows3D(origins=[here], vectors=[vector], colors=[colour], radii=0.03))
        for name, velocity in velocities.items():
            self._curve(f"speed_m_s/{name}", float(np.linalg.norm(velocity)))
            self._curve(f"course_deg/{name}", math.degrees(math.atan2(velocity[1], velocity[0])))

    def _curve(self, name: str, value: float) -> None:
        self._log(f"curves/{name}", rr.Scalars(value))


def open_viewer(path: Path) -> int:
    """Shows a file in Rerun's viewer until that is closed; gives its exit code."""
    command = [sys.executable, "-m", "rerun_cli", str(path), "--bind", "127.0.0.1", "--port", "auto"]
    return subprocess.run(command, env=viewer_environment(), check=False).returncode


def viewer_environment() -> dict[str, str]:
    """In which Rerun's programs keep to themselves."""
    return {name: value for name, value in os.environ.items() if name != _FORCES_STATISTICS} | _ENVIRONMENT


def _blueprint(rig: Rig) -> Any:
    seen = [
        rrb.Spatial2DView(name=name, origin=f"{_BODY}/{name}", contents=["$origin", "$origin/image", "$origin/labels"])
        for name in rig.cameras
    ]
    depth = [rrb.Spatial2DView(name=name, origin=f"{_BODY}/{name}", contents=["$origin/depth"]) for name in rig.cameras]
    clear = [f"- /{_BODY}/{name}/depth" for name in rig.cameras]  # what is far would hide the neighbours
    eye = rrb.EyeControls3D(position=(-9.0, -3.0, -6.0), look_target=(0.0, 0.0, 0.0))
    curves = [
        rrb.TimeSeriesView(name=title, origin=f"curves/{name}")
        for name, title in {
            "speed_m_s": "speed, m/s",
            "neighbours_m": "neighbours, m",
            "course_deg": "course, degrees",
            "stages_ms": "stages, ms",
        }.items()
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Tabs(
                    rrb.Spatial3DView(name="3D", origin=_HERE, contents=["/world/**", *clear], eye_controls=eye),
                    rrb.Spatial3DView(name="depth in 3D", origin=_HERE, contents="/world/**", eye_controls=eye),
                ),
                rrb.TextLogView(name="log", origin="log"),
                row_shares=[4, 1],
            ),
            rrb.Vertical(
                rrb.Tabs(rrb.Grid(*seen, name="images and drones"), rrb.Grid(*depth, name="depth")),
                rrb.Grid(*curves, grid_columns=2, name="curves"),
                row_shares=[3, 2],
            ),
            column_shares=[1, 1],
        ),
        collapse_panels=True,
    )


def colour_of(number: int) -> tuple[int, int, int]:
    """The colour of a drone or a track, by its number."""
    return _DRONES[number % len(_DRONES)]


def jpeg(image: UInt8Array) -> bytes:
    """An RGB image (h, w, 3), encoded."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])


def _depth_png(depth: Float32Array) -> bytes:
    """In centimetres; 0 is the sky, and what else is not known."""
    known = np.isfinite(depth) & (depth > 0) & (depth < _FARTHEST_M)
    units = np.where(known, np.round(np.where(known, depth, 0.0) * _DEPTH_UNITS_A_METRE), 0)
    return bytes(cv2.imencode(".png", units.astype(np.uint16))[1])

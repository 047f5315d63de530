"""A whole flight for Rerun, from the recordings of its drones: the flock in 3D, who knows whom, and all images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from flockd.core.messages import FloatArray, PilotOutput
from flockd.onboard.recording.codec import from_json
from flockd.onboard.recording.reader import RecordedStep
from flockd.onboard.recording.truth import Truth
from flockd.review.view.rerun_file import RerunWriter, colour_of, jpeg

_DRONE_RADIUS_M = 0.3
_NEIGHBOUR_RADIUS_M = 0.12


class FlockFile:
    """Writes one `.rrd` file of several drones, in the axes of their common truth: m north, east and down.

    A ball is a drone where it truly was; a small ball in the same colour is where that drone took a neighbour to be.
    Raises OSError where the file cannot be.
    """

    def __init__(self, path: Path, name: str, cameras: Mapping[str, Sequence[str]]) -> None:
        """``cameras``: the names of each recorded drone's cameras, by the drone's name."""
        self._tracks: dict[str, list[list[float]]] = {}
        self._shown: set[int] = set()
        self._file = RerunWriter(path, name, _blueprint(cameras))
        self._log = self._file.log

    def show(self, drone: str, step: RecordedStep) -> None:
        """Adds one step of one drone; steps of one drone in order, drones one after the other."""
        if step.truth is None:
            return
        self._file.at(step.frames.time_s, step.number)
        if step.number not in self._shown:
            self._shown.add(step.number)
            self._show_flock(step.truth)
        for name, frame in step.frames.frames.items():
            image = rr.EncodedImage(contents=jpeg(frame.image), media_type="image/jpeg")
            self._log(f"images/{drone}/{name}", image)
        if step.output is not None:
            self._show_neighbours(drone, from_json(PilotOutput, step.output), step.truth)

    def close(self) -> None:
        """Ends the file."""
        for number, (drone, track) in enumerate(self._tracks.items()):
            self._log(f"world/path/{drone}", rr.LineStrips3D([track], colors=[colour_of(number)]), static=True)
        self._file.close()

    def _show_flock(self, truth: Truth) -> None:
        places: dict[str, FloatArray] = {drone.name: drone.position for drone in truth.drones}
        for name, place in places.items():
            self._tracks.setdefault(name, []).append(place.tolist())
        colours = [colour_of(number) for number in range(len(places))]
        balls = rr.Points3D(list(places.values()), radii=_DRONE_RADIUS_M, colors=colours, labels=list(places))
        self._log("world/drones", balls)
        velocities = [drone.velocity for drone in truth.drones]
        self._log("world/velocity", rr.Arrows3D(origins=list(places.values()), vectors=velocities, colors=colours))
        for one, other in combinations(places, 2):
            apart_m = float(np.linalg.norm(places[one] - places[other]))
            self._log(f"curves/distance_m/{one}_{other}", rr.Scalars(apart_m))
        for name, place in places.items():
            self._log(f"curves/height_m/{name}", rr.Scalars(float(-place[2])))

    def _show_neighbours(self, drone: str, output: PilotOutput, truth: Truth) -> None:
        names = [one.name for one in truth.drones]
        if drone not in names:
            return
        here = truth.drones[names.index(drone)].position
        known = [neighbour for neighbour in output.neighbours if neighbour.confirmed]
        places = [here + neighbour.position for neighbour in known]
        colour = colour_of(names.index(drone))
        balls = rr.Points3D(places, radii=_NEIGHBOUR_RADIUS_M, colors=[colour] * len(places))
        self._log(f"world/neighbours/{drone}", balls)
        lines = rr.LineStrips3D([[here, place] for place in places], colors=[colour] * len(places), radii=0.01)
        self._log(f"world/neighbours/{drone}/lines", lines)


def _blueprint(cameras: Mapping[str, Sequence[str]]) -> Any:
    images = [
        rrb.Grid(*(rrb.Spatial2DView(name=name, origin=f"images/{drone}/{name}") for name in names), name=drone)
        for drone, names in cameras.items()
    ]
    eye = rrb.EyeControls3D(position=(-12.0, -4.0, -12.0), look_target=(0.0, 0.0, -4.0))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(name="flock", origin="/world", contents="/world/**", eye_controls=eye),
            rrb.Vertical(
                rrb.Tabs(*images),
                rrb.Grid(
                    rrb.TimeSeriesView(name="distance in 3D, m", origin="curves/distance_m"),
                    rrb.TimeSeriesView(name="height, m", origin="curves/height_m"),
                ),
                row_shares=[3, 2],
            ),
        ),
        collapse_panels=True,
    )

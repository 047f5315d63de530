"""What single images show under each fault of `config/campaigns/cameras.yaml`: its quick version, without flights.

    python -m tools.measure.camera_faults [--moments 4] [--only jpeg gain]

Moments of the campaign's ideal flight are drawn once, filmed by the cameras of each case, and shown to a pilot that has
seen nothing before: found drones, false ones, and errors of range. Faults of timing and attitude need flights.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flockd.campaign.flight_plan import CASE, Plan
from flockd.core.config import ScenarioConfig
from flockd.core.config.imperfect_cameras import CamerasConfig
from flockd.core.data import data_path
from flockd.core.messages import Detection, FloatArray, Frame, FrameSet, VehicleState
from flockd.flight.geometry import build_rig
from flockd.flight.perception import load_networks
from flockd.flight.pilot import FlockPilot
from flockd.sim.camera_simulator import CameraSimulator
from flockd.sim.real_cameras import CameraMotion, real_cameras
from flockd.sim.truth_perception import RenderTruth
from flockd.sim.vehicles import Vehicles

APART_S = 2.0
"""Between two moments."""
SAME_RAD = math.radians(5.0)
"""Nearer than this to a drone's true bearing a detection is of it."""


@dataclass(frozen=True, eq=False)
class Moment:
    """One moment of the first drone, as ideal cameras see it."""

    time_s: float
    truth: RenderTruth
    motions: dict[str, CameraMotion]
    sun: FloatArray
    vehicle: VehicleState
    neighbours: FloatArray
    """(n, 3) metres, body axes."""


def main() -> None:
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=4)
    parser.add_argument("--only", nargs="+", default=[""], metavar="CASE", help="cases whose names begin so")
    arguments = parser.parse_args()
    plan = Plan.load(data_path("config") / "campaigns" / "cameras.yaml")
    cases = {str(cell.parameters[CASE]): plan.recipe(cell, 0).scenario() for cell in plan.cells}
    ideal = cases["ideal"]
    moments, networks = list(_moments(ideal, arguments.moments)), load_networks(ideal.drone.perception)
    print("| case | found | false | range error, median | largest |\n|---|---|---|---|---|")
    for name, scenario in cases.items():
        assert scenario.cameras is not None
        still = CamerasConfig.model_validate({**scenario.cameras.model_dump(), "timing": {}, "attitude": {}})
        if (still == CamerasConfig() and name != "ideal") or not name.startswith(tuple(arguments.only)):
            continue
        lenses = {camera: mounted.camera for camera, mounted in build_rig(ideal.drone.rig).cameras.items()}
        cameras = real_cameras(scenario.cameras, lenses, 1, ideal.seed)
        found, false = 0, 0
        errors: list[float] = []
        for moment in moments:
            frames = {}
            for camera, motion in moment.motions.items():
                real = cameras[0, camera]
                shaken = CameraMotion(motion.velocity, motion.turn, real.shaking.around(moment.time_s), motion.drones)
                sun = moment.sun @ moment.truth.R_ned_cameras[camera]
                image = real.image(moment.truth.views[camera], shaken, moment.time_s, sun)
                frames[camera] = Frame(camera, real.compressed(image), moment.time_s, 0)
            output = FlockPilot(ideal.drone, networks).step(FrameSet(moment.time_s, frames), moment.vehicle)
            of_moment = [error for error in _errors(moment.neighbours, output.detections) if error is not None]
            found += len(of_moment)
            errors += of_moment
            false += len(output.detections) - len(of_moment)
        total = sum(len(moment.neighbours) for moment in moments)
        middle, most = (f"{100 * value:.0f} %" for value in (np.median(errors or [np.nan]), max(errors or [np.nan])))
        print(f"| {name} | {found} of {total} | {false} | {middle} | {most} |", flush=True)


def _moments(scenario: ScenarioConfig, count: int) -> Iterator[Moment]:
    simulator, vehicles = CameraSimulator(scenario), Vehicles(scenario.vehicles, scenario.vehicle, seed=scenario.seed)
    velocities = np.array([vehicle.velocity_m_s for vehicle in scenario.vehicles])
    for number in range(1, count + 1):
        # Each flies on as it began, turning slowly.
        vehicles.step(velocities, np.full(len(velocities), 0.3 * APART_S * number), APART_S)
        time_s = APART_S * number
        _, truth = simulator.capture(0, number, time_s, vehicles, vehicles.trail)
        motions = {
            name: simulator.motion(0, name, time_s, turn, vehicles.trail) for name, turn in truth.R_ned_cameras.items()
        }
        place, R = vehicles.position[0], vehicles.R_ned_body[0]
        state = VehicleState(time_s, R, -float(place[2]), vehicles.velocity[0])
        yield Moment(time_s, truth, motions, simulator.sun, state, (vehicles.position[1:] - place) @ R)


def _errors(neighbours: FloatArray, detections: tuple[Detection, ...]) -> list[float | None]:
    """The range error of each neighbour's best detection, as a share; None where there is none."""
    found: list[float | None] = []
    for place in neighbours:
        range_m = float(np.linalg.norm(place))
        mine = [d for d in detections if d.bearing @ place / range_m > math.cos(SAME_RAD)]
        nearest = min(mine, key=lambda d: abs(d.range_m - range_m), default=None)
        found.append(None if nearest is None else abs(nearest.range_m / range_m - 1))
    return found


if __name__ == "__main__":
    main()

"""True networks for tests of the pilot and of perception: what is left is the code's own doing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest

from flockd.core.data import data_path
from flockd.core.messages import Float32Array, Frame, FrameSet, PilotOutput, UInt8Array, VehicleState
from flockd.flight.geometry import RigCamera
from flockd.flight.perception import Crops, Perception, RangeEstimates, SceneMaps
from flockd.flight.pilot import FlockPilot
from flockd.sim.cameras import camera_simulator
from flockd.sim.cameras.camera_simulator import CameraSimulator
from flockd.sim.scenario import ScenarioConfig, load_scenario
from flockd.sim.vehicles.vehicles import Vehicles
from tests.flight.pilot.true_networks import TrueNetworks
from tests.make import small_eyes

STEP_S = 0.5
BAROMETER = {"drone.perception.height": "barometer"}
"""Its vehicle states hold no range."""
CRUISE = np.array([[1.0, 0.0], [0.8, 0.2], [0.8, 0.2]])
TURNED = np.array([0.2, 0.0, 0.0])


def scenario_with(*places: tuple[float, float, float], sharp: bool = False) -> ScenarioConfig:
    """Drones at these places; ``sharp``: in images of the full size, for one that is far."""
    scenario = load_scenario(data_path("config") / "paper_flight.yaml", {"seed": 4, "ideal": True, **BAROMETER})
    scenario = scenario if sharp else small_eyes(scenario, every=1)
    start = scenario.vehicles[0]
    drones = tuple(start.model_copy(update={"position_m": place, "velocity_m_s": (1.0, 0.0)}) for place in places)
    return scenario.model_copy(update={"vehicles": drones})


class SpoilableTruth(TrueNetworks):
    """The truth, where a test puts nothing else in the place of a role."""

    def __init__(self, cameras: CameraSimulator | None = None) -> None:
        super().__init__(cameras)
        self.instead: dict[str, Callable[..., Any]] = {}
        """By role (``flow``, ``scene``, ``ranges``)."""

    def sound(self, role: str) -> Callable[..., Any]:
        """The truth's own."""
        return cast("Callable[..., Any]", getattr(super(), role))

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        return cast("Float32Array", self.instead.get("flow", super().flow)(first, second, labels))

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        return cast("SceneMaps", self.instead.get("scene", super().scene)(frame, camera, ground))

    def ranges(self, crops: Crops) -> RangeEstimates:
        return cast("RangeEstimates", self.instead.get("ranges", super().ranges)(crops))


class Flyer:
    """Drone 0 of a scenario with true networks, while the others fly straight on."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        self.scenario = scenario
        with pytest.MonkeyPatch.context() as patch:  # one world, wherever the drones begin
            patch.setattr(camera_simulator, "planned_path", lambda _: np.zeros((1, 2)))
            patch.setattr(camera_simulator, "_spread", lambda _: 12.0)
            self.cameras = camera_simulator.CameraSimulator(scenario, threads=0)
        self.truth = SpoilableTruth(self.cameras)
        self.pilot = FlockPilot(scenario.drone, self.truth)
        self.vehicles = Vehicles(scenario.vehicles, scenario.vehicle)
        self.time_s = 100.0
        self.steps = 0

    def perception(self) -> Perception:
        """A fresh one."""
        config = self.scenario.drone.perception.model_copy(update={"scale": "network"})
        return Perception(self.cameras.rig, self.truth, config)

    def take_frames(self) -> tuple[FrameSet, VehicleState]:
        frames = self.cameras.capture(0, self.steps, self.time_s, self.vehicles)()
        v = self.vehicles
        return frames, VehicleState(self.time_s, v.R_ned_body[0], -float(v.position[0, 2]), v.velocity[0])

    def step(self) -> PilotOutput:
        return self.pilot.step(*self.take_frames())

    def move(self) -> None:
        count = len(self.scenario.vehicles)
        self.vehicles.step(CRUISE[:count], TURNED[:count], STEP_S)
        self.time_s += STEP_S
        self.steps += 1

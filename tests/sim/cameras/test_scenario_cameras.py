"""A scenario's cameras, whole: ideal ones change no bit, real ones are the same each time, late ones show before;
each fault alone is seen."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest

from flockd.campaign.flight_plan import Plan
from flockd.core.config import load_drone
from flockd.core.data import data_path
from flockd.core.messages import Frame
from flockd.flight.geometry import build_rig
from flockd.sim.cameras.camera_simulator import CameraSimulator
from flockd.sim.cameras.imperfect_cameras import CamerasConfig
from flockd.sim.cameras.lens_views import lens_view
from flockd.sim.scenario import CameraFaultConfig, ScenarioConfig, load_scenario
from flockd.sim.vehicles.vehicles import Vehicles

CONFIG = data_path("config")
RIG = load_drone(CONFIG / "quadrotor.yaml").rig
AS_MOUNTED = {"shutter": {"readout_from": "right"}, "reduce": 2}
"""As `turn_deg: 90` and `reduce: 2` of `quadrotor.yaml` have it."""


def scenario_with(cameras: CamerasConfig | None, image_noise: float = 2.0) -> ScenarioConfig:
    """Two drones, one ahead of the other, with two of the lenses of `quadrotor.yaml` at a quarter of their size."""
    paper = load_scenario(CONFIG / "paper_flight.yaml", {"sensors.image_noise": image_noise, "ideal": True})
    rig = []
    for camera in RIG.cameras[:2]:
        quarter = {name: getattr(camera.intrinsics, name) / 4 for name in ("fx", "fy", "cx", "cy")}
        intrinsics = camera.intrinsics.model_copy(update=quarter)
        rig.append(camera.model_copy(update={"size_px": (160, 120), "intrinsics": intrinsics}))
    drone = paper.drone.model_copy(update={"rig": RIG.model_copy(update={"cameras": tuple(rig)})})
    places = ((0.0, 0.0, -3.0), (3.0, 0.4, -3.2))
    vehicles = tuple(paper.vehicles[0].model_copy(update={"position_m": place}) for place in places)
    return paper.model_copy(update={"drone": drone, "vehicles": vehicles, "cameras": cameras})


def flown_frames(scenario: ScenarioConfig, threads: int = 0, steps: int = 3) -> list[dict[str, Frame]]:
    simulator, vehicles = CameraSimulator(scenario, threads), Vehicles(scenario.vehicles, scenario.vehicle)
    seen = []
    for step in range(steps):
        seen.append(dict(simulator.capture(0, step, 0.5 * step, vehicles, vehicles.trail)().frames))
        vehicles.step(np.array([[1.0, 0.5], [1.0, 0.0]]), np.array([0.6, 0.0]), 0.5)
    return seen


def images(frames: list[dict[str, Frame]]) -> list[Any]:
    return [{name: frame.image.tolist() for name, frame in step.items()} for step in frames]


def test_without_cameras_and_with_ideal_ones_an_image_is_the_view_as_it_is_drawn() -> None:
    """Drawn here once more by the renderer alone."""
    scenario = scenario_with(None, image_noise=0.0)
    simulator, vehicles = CameraSimulator(scenario, 0), Vehicles(scenario.vehicles, scenario.vehicle)
    frames = simulator.capture(0, 0, 0.0, vehicles, vehicles.trail)().frames
    for name, mounted in build_rig(scenario.drone.rig).cameras.items():
        turn = vehicles.R_ned_body[0] @ mounted.T_body_camera.rotation
        place = vehicles.position[0] + vehicles.R_ned_body[0] @ mounted.T_body_camera.translation
        drawn = lens_view(
            mounted.camera,
            lambda matrix, size, part, turn=turn, place=place: simulator._renderer.render(  # type: ignore[misc]
                matrix, size, turn @ part, place,
                drone_rotations=vehicles.R_ned_body, drone_positions=vehicles.position, shown=[1],
            ),
        )  # fmt: skip
        assert np.array_equal(frames[name].image, drawn.rgb)
    noisy = [images(flown_frames(scenario_with(cameras))) for cameras in (None, CamerasConfig())]
    assert noisy[0] == noisy[1]


def test_real_cameras_are_the_same_each_time_on_any_threads_and_others_with_another_seed() -> None:
    scenario = scenario_with(CamerasConfig(preset="realistic"))
    one = images(flown_frames(scenario))
    assert one == images(flown_frames(scenario, threads=2))
    assert one != images(flown_frames(scenario.model_copy(update={"seed": 1})))
    assert one != images(flown_frames(scenario_with(None)))


def test_a_late_image_is_that_of_before_under_its_own_stamp() -> None:
    """200 ms late: bit for bit what an ideal camera shows 200 ms before, from where the drones were then."""
    scenario = scenario_with(CamerasConfig.model_validate({"timing": {"delay_s": 0.2}}), image_noise=0.0)
    late = flown_frames(scenario)[2]["front"]
    assert late.time_s == 1.0
    simulator = CameraSimulator(scenario.model_copy(update={"cameras": None}), 0)
    vehicles = Vehicles(scenario.vehicles, scenario.vehicle)
    yaws = np.array([0.6, 0.0])
    for _ in range(2):
        vehicles.step(np.array([[1.0, 0.5], [1.0, 0.0]]), yaws, 0.5)
    before = simulator.capture(0, 0, 0.8, vehicles.trail.at(0.8))().frames["front"].image
    assert np.array_equal(late.image, before)
    assert not np.array_equal(late.image, simulator.capture(0, 0, 1.0, vehicles)().frames["front"].image)


def test_images_that_never_come_are_missing() -> None:
    scenario = scenario_with(CamerasConfig.model_validate({"timing": {"dropped": 1.0}}))
    assert flown_frames(scenario, steps=1) == [{}]


def test_a_camera_that_fails_delivers_nothing_from_its_begin_to_its_end() -> None:
    fault = CameraFaultConfig(drone=1, camera="front", begin_s=0.5, end_s=1.0)
    scenario = scenario_with(None).model_copy(update={"faults": (fault,)})
    assert ["front" in frames for frames in flown_frames(scenario)] == [True, False, True]


def test_a_preset_fills_what_is_not_written() -> None:
    cameras = CamerasConfig.model_validate({"preset": "realistic", "shutter": {"readout_s": 0.0}})
    assert (cameras.shutter.exposure_s, cameras.shutter.readout_s) == (0.005, 0.0)
    assert cameras.compression.jpeg_quality == 80
    assert CamerasConfig.model_validate(cameras.model_dump()) == cameras, "as `config show` prints it"
    assert CamerasConfig.model_validate_json(cameras.model_dump_json()) == cameras
    assert CamerasConfig.model_validate({"shutter": {"readout_s": 0.01}}).shutter.exposure_s == 0.0


def test_the_fisheye_flight_has_the_real_drones_lenses() -> None:
    scenario = load_scenario(CONFIG / "fisheye_flight.yaml")
    assert scenario.drone.rig == RIG
    assert scenario.cameras == CamerasConfig.model_validate({"preset": "realistic", **AS_MOUNTED})
    ideal = load_scenario(CONFIG / "fisheye_flight.yaml", {"cameras.preset": "ideal"})
    assert ideal.cameras == CamerasConfig.model_validate(AS_MOUNTED)


def test_a_campaigns_preset_takes_the_place_of_its_scenarios() -> None:
    """Before, the scenario's realistic values stayed under a case's `preset: ideal`."""
    plan = Plan.load(CONFIG / "campaigns" / "cameras.yaml")
    flown = {str(cell.parameters["case"]): plan.task(cell, 0).scenario().cameras for cell in plan.cells}
    assert flown["ideal"] == CamerasConfig.model_validate(AS_MOUNTED)
    assert flown["realistic"] == CamerasConfig.model_validate({"preset": "realistic", **AS_MOUNTED})
    assert flown["gain_8"] == CamerasConfig.model_validate({"noise": {"gain": 8.0}, **AS_MOUNTED})


FAULTS: Mapping[str, tuple[Mapping[str, Mapping[str, Any]], float]] = {
    "exposure": ({"shutter": {"exposure_s": 0.03}}, 0.1),
    "readout": ({"shutter": {"readout_s": 0.05}}, 0.1),
    "shake": ({"shake": {"rms_deg": 2.0, "frequency_hz": 40.0}}, 1.0),
    "shake in the exposure": ({"shake": {"rms_deg": 2.0, "frequency_hz": 200.0}, "shutter": {"exposure_s": 0.01}}, 1.0),
    "noise": ({"noise": {"gain": 8.0}}, 1.0),
    "flare": ({"lens": {"flare": 0.2}}, 1.0),
    "JPEG": ({"compression": {"jpeg_quality": 30}}, 0.5),
}
"""What is configured, and by how many grey levels an image then differs from an ideal camera's at least."""


@cache
def _last(name: str) -> dict[str, Frame]:
    cameras = CamerasConfig.model_validate(FAULTS[name][0] if name else {})
    return flown_frames(scenario_with(cameras, image_noise=0.0), steps=2)[-1]


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_that_is_configured_is_seen(name: str) -> None:
    ideal, real = _last("")["front"].image.astype(float), _last(name)["front"].image.astype(float)
    assert np.abs(real - ideal).mean() > FAULTS[name][1]


def test_shaking_within_an_exposure_blurs_beside_turning_the_image() -> None:
    """Edges: neighbouring pixels of a sharp image differ more."""
    sharp, blurred = (
        np.abs(np.diff(_last(name)["front"].image.astype(float), axis=1)).mean()
        for name in ("shake", "shake in the exposure")
    )
    assert blurred < 0.9 * sharp

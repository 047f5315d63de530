"""The swarm loop: the same seed is the same flight, and nobody needs anybody's telemetry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from flockd.core.messages import FrameSet, VehicleState
from flockd.flight.pilot import FlockPilot
from flockd.onboard.telemetry import TelemetrySink
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.summary import summarise
from flockd.sim.flock.swarm import Flight, fly
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.sitl.processes import free_endpoint
from tests import make
from tests.sim.flock.watching import Watching

STEPS = 3


def scenario(duration_s: float = 0.5 * STEPS, height: str = "best", *, ideal: bool = False) -> ScenarioConfig:
    overrides = {
        "duration_s": duration_s, "seed": 5, "drone.perception.flow": "dis", "drone.perception.height": height,
        "ideal": ideal,
    }  # fmt: skip
    return make.small_eyes(make.scenario(overrides, drones=2))


def flown(telemetry: TelemetrySink) -> FlightLog:
    announced = Watching()
    log = fly(scenario(), shown=announced.shown(scenario(), telemetry), threads=0).log
    pictures = [newest("front") for newest in announced.image.values()]
    assert [picture[:2] for picture in pictures if picture is not None] == [b"\xff\xd8"] * 2, "JPEGs of both"
    return log


TOLD: list[VehicleState] = []
"""The vehicles' states that the pilots of `cut` got, in each step one after the other."""


@pytest.fixture(scope="module")
def cut() -> Flight:
    """A flight on one thread, in which all telemetry is cut."""
    step = FlockPilot.step

    def noted(self: FlockPilot, frames: FrameSet, vehicle: VehicleState, *rest: Any) -> Any:
        TOLD.append(vehicle)
        return step(self, frames, vehicle, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FlockPilot, "step", noted)
        return fly(scenario(), threads=0)


@pytest.fixture(scope="module")
def alone(cut: Flight) -> FlightLog:
    return cut.log


def assert_same_flight(a: FlightLog, b: FlightLog) -> None:
    for part in fields(FlightLog):
        if part.name not in ("stages_ms", "metadata"):
            assert getattr(a, part.name).tobytes() == getattr(b, part.name).tobytes(), part.name


def test_the_same_seed_is_the_same_flight_on_however_many_threads(cut: Flight) -> None:
    again = fly(scenario(), threads=2)
    assert_same_flight(cut.log, again.log)
    assert [(frame.time_s, frame.drone) for frame in again.key_frames] == [(0.5, 0), (1.0, 0), (0.5, 1), (1.0, 1)]
    for one, other in zip(cut.key_frames, again.key_frames, strict=True):
        for maps in ("images", "depth", "labels", "flow"):
            ours, theirs = getattr(one, maps), getattr(other, maps)
            assert {camera: a.tobytes() for camera, a in ours.items()} == {c: a.tobytes() for c, a in theirs.items()}
        assert (one.track_ids, one.ranges) == (other.track_ids, other.ranges)


def test_pilots_get_what_their_autopilots_say_and_not_the_truth(alone: FlightLog) -> None:
    """Of each step and drone: attitude, velocity and position are off, by about what is configured."""
    sensors, count = scenario().sensors, alone.position.shape[1]
    assert len(TOLD) == count * STEPS
    for number, state in enumerate(TOLD):
        step, drone = divmod(number, count)
        assert state.velocity_ned is not None and state.position is not None
        off = {
            "attitude": np.abs(state.R_ned_body - alone.attitude[step, drone]).max()
            / np.radians(sensors.heading_error_deg),
            "velocity": np.abs(state.velocity_ned - alone.velocity[step, drone]).max() / sensors.velocity_error_m_s,
            "position": np.abs(state.position - alone.position[step, drone, :2]).max() / sensors.position_error_m,
            "height": abs(state.height_m + alone.position[step, drone, 2]) / sensors.barometer_noise_m,
        }
        assert all(0.001 < errors < 6.0 for errors in off.values()), off


class Tampering:
    """A telemetry sink that publishes what it is told, and would spoil it then if it could."""

    def __init__(self, real: TelemetrySink) -> None:
        self.told: list[tuple[str, str]] = []
        self._real = real

    def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
        self.told.append((drone, topic))
        self._real.publish(drone, topic, dict(message))
        if isinstance(message, dict):
            message.clear()


def test_drones_fly_blind_to_each_others_telemetry(alone: FlightLog) -> None:
    """Cut, or real and tampered with: bit for bit the same flight."""
    with ZenohTelemetry("test", listen=(free_endpoint(),)) as zenoh:
        tampered = Tampering(zenoh)
        assert_same_flight(alone, flown(tampered))
    assert {drone for drone, _ in tampered.told} == {"drone1", "drone2"}


def test_each_drone_decides_from_its_own_images_alone() -> None:
    """The autopilots may err about the velocity: the first step's own motion and command do not change.

    Vehicles fly by the truth here, as what their autopilots believe would move them.
    By the barometer: the ground below a range finder is followed with the own autopilot's velocity.
    """
    changed = scenario(1.0, height="barometer", ideal=True)
    sensors = changed.sensors.model_copy(update={"velocity_error_m_s": 0.3})
    wrongly = changed.model_copy(update={"sensors": sensors})
    right, wrong = (fly(flight, threads=0).log for flight in (changed, wrongly))
    assert np.isfinite(right.ego_translation[1]).all()
    assert np.array_equal(right.ego_translation[1], wrong.ego_translation[1])
    assert np.array_equal(right.command_velocity[0], wrong.command_velocity[0])


def test_pilots_that_see_take_an_operators_order() -> None:
    watching, flight = Watching(), scenario(1.0)

    def order(done: int, total: int) -> None:
        assert done == total or all(watching.goto(drone, -4.5, -4.0)[0] for drone in ("drone1", "drone2"))

    log = fly(flight, shown=watching.shown(flight), threads=2, progress=order).log
    np.testing.assert_array_equal(log.goal, [[np.nan, np.nan], [-4.5, -4.0]])


def test_an_interrupted_flight_is_what_was_flown() -> None:
    def interrupt(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    log = fly(scenario(), threads=2, progress=interrupt).log
    assert (len(log.time_s), log.metadata.interrupted) == (2, True)


@pytest.mark.slow
def test_twenty_seconds_from_pixels() -> None:
    """Seed 0: 1.80 m, 0.978, 0.929 (confirmation takes time), no false one. Of a flock that sees nobody, two come
    within 0.53 m."""
    summary = summarise(fly(make.scenario({"duration_s": 20.0})).log)
    assert summary["flock"]["min_distance_after_10s_m"] >= 1.5
    assert summary["flock"]["order_tail"] >= 0.95
    assert summary["flock"]["union_tail"] == 1.0
    assert summary["neighbours"]["recall_within_10m"] >= 0.9
    assert summary["neighbours"]["false_per_drone_minute"] < 1.0

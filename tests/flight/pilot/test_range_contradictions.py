"""A range finder that lies is found out by the barometer's height, and hills, steps and drift are no lies."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from flockd.core.choices import HeightSource
from flockd.core.config.perception import RangeFinderParameters
from flockd.core.messages import FloatArray, GroundEstimate, RangeReading, Reason, ReasonKind
from flockd.flight.geometry import rotation_from_euler
from flockd.flight.pilot.ground import GroundFilter
from flockd.sim.autopilot.fake_range_finder import FakeRangeFinder
from flockd.sim.scenario import RangeFinderConfig
from flockd.sim.world.terrain import hills
from tests.make import vehicle

pytestmark = pytest.mark.fault("range-finder-lies")

STEP_S = 0.5
LIE = Reason(ReasonKind.HEIGHT, "height: the range contradicts the barometer; the barometer's is used")
STUCK = Reason(ReasonKind.HEIGHT, "height: the range stays the same while the height changes; the barometer's is used")
WAY = Reason(ReasonKind.HEIGHT, "height: the range contradicts the way flown; the barometer's is used")
Told = tuple[GroundEstimate | None, Reason | None]


class Drone:
    """One that flies over level ground with a sensor that says what a story wants."""

    def __init__(self, source: HeightSource = "best", height_m: float = 4.0, **parameters: float) -> None:
        self.below = GroundFilter(source, RangeFinderParameters.model_validate(parameters))
        self.time_s, self.height_m, self.north_m = 0.0, height_m, 0.0

    def step(
        self,
        range_m: float | None,
        *,
        climb_m_s: float = 0.0,
        north_m_s: float = 0.0,
        R: FloatArray | None = None,
        believed: FloatArray | None = None,
    ) -> Told:
        """Half a second on; by default the range is the height. ``believed``: the autopilot's velocity."""
        self.time_s += STEP_S
        self.height_m += climb_m_s * STEP_S
        self.north_m += north_m_s * STEP_S
        said = RangeReading(self.time_s, self.height_m if range_m is None else range_m, min_m=0.1, max_m=40.0)
        flies = {"R_ned_body": np.eye(3) if R is None else R, "position": [self.north_m, 0.0]}
        flies["velocity_ned"] = np.zeros(3) if believed is None else believed
        return self.below.update(vehicle(self.time_s, self.height_m, **flies, ground_range=said))

    def hovers(self, seconds: float, range_m: float | None = None) -> list[Told]:
        return [self.step(range_m) for _ in range(round(seconds / STEP_S))]


def source(told: Told) -> str:
    assert isinstance(told[0], GroundEstimate)
    return told[0].source


def test_stuck_while_the_drone_climbs_it_is_not_used_and_the_barometer_is() -> None:
    """From the start on the height that is used never errs by more than the tolerance and 8 % of the range."""
    drone = Drone(height_m=2.0)
    drone.hovers(3.0)
    climb = [drone.step(2.0, climb_m_s=0.3) for _ in range(30)]
    for k, told in enumerate(climb):
        assert isinstance(told[0], GroundEstimate)
        assert abs(told[0].height_m - (2.0 + 0.15 * (k + 1))) <= 1.0 + 0.08 * 2.0 + 2 * 0.15
    assert source(climb[-1]) == "barometer"
    assert climb[-1][1] == STUCK


def climbs_at_an_angle(
    drone: Drone, steps: int, range_m: Callable[[int], float], *, ground_rise: float = 0.0
) -> list[tuple[Told, float]]:
    """Flies north at 1 m/s and up at 0.2: what is told at each step, and the true height above the ground.

    The images show the way in the scale of the height that is used, which is off by as much as that.
    """
    velocity, flown = np.array([1.0, 0.0, -0.2]), []
    clearance_m = drone.height_m
    for k in range(steps):
        told = drone.step(range_m(k), climb_m_s=0.2, north_m_s=1.0, believed=velocity)
        clearance_m += (0.2 - ground_rise) * STEP_S
        assert isinstance(told[0], GroundEstimate)
        drone.below.see_motion(velocity * STEP_S * told[0].height_m / clearance_m)
        flown.append((told, clearance_m))
    return flown


@pytest.mark.parametrize(
    ("noise_m", "reason", "most_off"), [(0.0, STUCK, 0.25), (0.01, WAY, 0.5)], ids=["to the last bit", "with noise"]
)
def test_stuck_during_a_climb_of_twenty_per_cent_it_is_found_out(
    noise_m: float, reason: Reason, most_off: float
) -> None:
    """Ground that rises as fast looks the same to range finder and barometer: it was believed for the whole flight, at
    its end 75 % off. Readings that are the same to the last bit tell, else the way flown, which takes longer.
    """
    drone = Drone(height_m=4.0)
    drone.hovers(3.0)
    flown = climbs_at_an_angle(drone, 120, lambda k: 4.0 + noise_m * (k % 3))
    off = [abs(told[0].height_m / true_m - 1.0) for told, true_m in flown if told[0] is not None]
    assert max(off) <= most_off
    assert (source(flown[-1][0]), flown[-1][0][1]) == ("barometer", reason)
    sources = [source(told) for told, _ in flown]
    first = sources.index("barometer")
    assert set(sources[first:]) == {"barometer"}, "never believed again while it is stuck"


@pytest.mark.parametrize("range_m", [0.3, 7.0], ids=["landing gear in the beam", "a jump"])
def test_what_is_suddenly_in_the_beam_is_not_the_ground(range_m: float) -> None:
    drone = Drone()
    drone.hovers(3.0)
    first, *others = drone.hovers(10.0, range_m)
    assert isinstance(first[0], GroundEstimate)
    assert first[0].height_m == pytest.approx(4.0), "bridged: it may be a bird"
    assert [told[1] for told in others] == [LIE] * len(others)
    assert all(isinstance(told[0], GroundEstimate) and told[0].height_m == 4.0 for told in others)


def test_what_is_in_the_beam_from_the_start_contradicts_home() -> None:
    """Where the height is zero the ground was, when the drone was armed there."""
    drone = Drone()
    assert drone.hovers(5.0, 0.3)[-1][1] == LIE
    far = Drone()
    far.north_m = 20.0
    assert source(far.hovers(5.0, 0.3)[-1]) == "range_finder", "a slope of 18 % would do that"


@pytest.mark.parametrize("north_m_s", [0.0, 1.0])
def test_it_is_found_at_once_and_believed_again_three_seconds_after_the_beam_is_free(north_m_s: float) -> None:
    """Within the 30 m flown a hill might rise by 3.7 m, but not from one range to the next."""
    drone = Drone()
    sources = [source(drone.step(0.3 if 60 <= k < 68 else None, north_m_s=north_m_s)) for k in range(78)]
    assert sources == ["range_finder"] * 61 + ["barometer"] * 13 + ["range_finder"] * 4


def _over_hills(seed: int) -> Callable[[FloatArray, FloatArray], FloatArray]:
    extent_m = 160.0
    heights = hills(np.random.default_rng(seed), extent_m, 5.0, 0.15)
    axis = np.linspace(-extent_m, extent_m, len(heights))
    at = RegularGridInterpolator((axis, axis), heights)
    return lambda north, east: np.asarray(at(np.column_stack([north, east])))


@pytest.mark.parametrize("seed", [0, 3])
def test_hills_of_fifteen_per_cent_never_contradict_the_barometer(seed: int) -> None:
    """150 s at 1 m/s with the simulator's sensor, rolling, while the barometer drifts by 0.3 m a minute."""
    rng = np.random.default_rng([seed, 1])
    ground = _over_hills(seed)
    sensor = FakeRangeFinder(RangeFinderConfig(dropouts_per_min=0.0), ground, (seed,))
    below, heading = GroundFilter("best", RangeFinderParameters()), float(rng.uniform(0.0, 2 * math.pi))
    velocity = np.array([math.cos(heading), math.sin(heading), 0.0])
    told, rises_m = set(), []
    for k in range(300):
        time_s = STEP_S * k
        R = rotation_from_euler(float(rng.normal(0.0, 0.1)), float(rng.normal(0.0, 0.1)), heading)
        position = velocity * time_s + np.array([0.0, 0.0, -8.0])
        reading = sensor.read(time_s, position, velocity, R)
        drift_m = 0.3 / 60.0 * time_s + float(rng.normal(0.0, 0.02))
        heard = vehicle(time_s, 8.0 + drift_m, R_ned_body=R, velocity_ned=velocity, position=position[:2])
        told.add(below.update(replace(heard, ground_range=reading))[1])
        rises_m.append(float(ground(position[:1], position[1:2])[0]))
    assert told == {None}
    assert np.ptp(rises_m) > 1.0, "there were hills"

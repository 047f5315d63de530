"""The ground below, from ranges along the body's down axis: analytic planes, and all that a range finder may do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from flockd.core.choices import HeightSource
from flockd.core.config.perception import RangeFinderParameters
from flockd.core.messages import FloatArray, GroundEstimate, RangeReading, Reason, ReasonKind, VehicleState
from flockd.flight.geometry import rotation_from_euler
from flockd.flight.pilot import FlockPilot
from flockd.flight.pilot.ground import ContradictionMonitor, GroundFilter
from flockd.sim.autopilot.fake_range_finder import range_to_ground
from tests.flight.pilot.flyer import Flyer, scenario_with
from tests.make import changed, vehicle

STEP_S = 0.5
LEVEL = np.eye(3)


def state(
    time_s: float,
    range_m: float | None,
    *,
    height_m: float = 4.0,
    north_m: float = 0.0,
    R: FloatArray = LEVEL,
    age_s: float = 0.02,
    quality: float | None = 1.0,
) -> VehicleState:
    """The state of a drone whose sensor measures from 0.2 to 12 m."""
    reading = None
    if range_m is not None:
        reading = RangeReading(time_s - age_s, range_m, min_m=0.2, max_m=12.0, quality=quality)
    return vehicle(time_s, height_m, R_ned_body=R, position=[north_m, 0.0], ground_range=reading)


def follower(source: HeightSource = "best") -> GroundFilter:
    return GroundFilter(source, RangeFinderParameters())


def known(found: tuple[GroundEstimate | None, Reason | None]) -> GroundEstimate:
    assert isinstance(found[0], GroundEstimate)
    return found[0]


def test_a_slant_range_is_turned_upright() -> None:
    R = rotation_from_euler(math.radians(10.0), math.radians(-20.0), 1.0)
    upright_m = 5.0 * math.cos(math.radians(10.0)) * math.cos(math.radians(20.0))
    ground = known(follower().update(state(0.0, 5.0, R=R)))
    assert ground.source == "range_finder"
    assert ground.height_m == pytest.approx(upright_m, abs=1e-9)


def test_successive_ranges_over_a_hillside_tell_its_slope() -> None:
    """The drone flies north at one height above home; the ground rises by 12 %, from 4 m below it."""
    below, rng = follower(), np.random.default_rng(0)
    ground = None
    for k in range(30):
        north_m = 0.5 * k
        true_m = 4.0 + 3.0 - 0.12 * north_m
        reading_m = true_m * (1.0 + 0.015 * float(rng.standard_normal()))
        ground = known(below.update(state(STEP_S * k, reading_m, height_m=7.5, north_m=north_m)))
    assert ground is not None
    assert ground.slope[0] == pytest.approx(0.12, abs=0.03)
    assert ground.slope[1] == pytest.approx(0.0, abs=1e-9)
    assert ground.height_m == pytest.approx(7.0 - 0.12 * 14.5, rel=0.02)


FAULTS: dict[str, Callable[[float], VehicleState]] = {
    "no range finder is heard": lambda t: state(t, None),
    "the range is not a number": lambda t: state(t, math.nan),
    "the range is too old": lambda t: state(t, 4.0, age_s=0.31),
    "the range finder's signal is too weak": lambda t: state(t, 4.0, quality=0.05),
    "the ground is nearer than the range finder measures": lambda t: state(t, 0.2),
    "the ground is farther than the range finder measures": lambda t: state(t, 12.0),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_without_a_good_range_the_barometer_serves_or_there_is_no_scale(fault: str) -> None:
    found, why = follower("best").update(FAULTS[fault](0.0))
    assert isinstance(found, GroundEstimate)
    assert (found.source, found.height_m) == ("barometer", 4.0)
    assert why is not None and why.kind is ReasonKind.HEIGHT and fault in why.text
    nowhere, why = follower("range_finder").update(FAULTS[fault](0.0))
    assert nowhere is None
    assert why is not None and why.kind is ReasonKind.HEIGHT and fault in why.text and "no scale" in why.text
    level = follower("barometer").update(FAULTS[fault](0.0))
    assert (known(level).source, level[1]) == ("barometer", None)


def test_a_short_dropout_is_bridged_by_the_own_motion_and_a_long_one_is_not() -> None:
    below = follower()
    below.update(state(0.0, 3.5))
    for time_s in (0.5, 1.0, 1.5, 2.0):
        ground = known(below.update(state(time_s, None, height_m=4.0 + time_s)))
        assert ground.source == "range_finder"
        assert ground.height_m == pytest.approx(3.5 + time_s)
    fallen = known(below.update(state(2.5, None, height_m=6.5)))
    assert (fallen.source, fallen.height_m) == ("barometer", 6.5)
    assert known(below.update(state(3.0, 6.0, height_m=6.5))).source == "range_finder", "it works again"


# A whole step over hills, on rendered frames with perception answered by the truth.


HEIGHT_M = 5.0


@pytest.fixture(scope="module")
def hilly() -> Flyer:
    """Over hills, away from the level place at the origin."""
    relief = {"world__hills_m": 5.0, "world__ground_relief_m": 0.02}
    given = changed(scenario_with((14.0, 12.0, -HEIGHT_M)), drone__perception__height="range_finder", **relief)
    return Flyer(given)


def test_a_range_gives_the_scale_of_a_step(hilly: Flyer) -> None:
    hilly.pilot = FlockPilot(hilly.scenario.drone, hilly.truth)
    frames, state = hilly.take_frames()
    down = hilly.vehicles.R_ned_body[0][:, 2]
    range_m = range_to_ground(hilly.vehicles.position[0], down, hilly.cameras.ground_height)
    output = hilly.pilot.step(frames, replace(state, ground_range=RangeReading(state.time_s, range_m)))
    assert output.ground is not None
    assert output.ground.source == "range_finder"
    assert output.ground.height_m == pytest.approx(range_m * down[2])
    assert not [reason for reason in output.reasons if reason.kind is ReasonKind.HEIGHT]


def test_without_a_range_there_is_no_scale_and_neighbours_are_seen_all_the_same(hilly: Flyer) -> None:
    hilly.pilot = FlockPilot(hilly.scenario.drone, hilly.truth)
    for _ in range(2):
        output, flies = hilly.step(), hilly.vehicles.velocity[0]
        hilly.move()
    assert [reason.kind for reason in output.reasons].count(ReasonKind.HEIGHT) == 1
    assert (output.ego_motion, output.ground) == (None, None)
    assert output.velocity == pytest.approx(flies), "as the autopilot says"


@pytest.mark.parametrize(("by_barometer", "contradicts"), [(1.0, True), (2.5, False)])
def test_the_way_flown_contradicts_a_range_only_where_the_barometer_fits_better(
    by_barometer: float, contradicts: bool
) -> None:
    """At 2 m/s, twice as far by the range; what both scales get wrong is the images' or the autopilot's fault."""
    flown, monitor = np.array([1.0, 0.0, 0.0]), ContradictionMonitor(RangeFinderParameters())
    for _ in range(40):
        monitor.see_way(0.5, flown, np.array([2.0 * flown, by_barometer * flown]))
    assert (monitor.why is not None) is contradicts

"""The last gate: what passes, what is made smaller, what is refused; by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flockd.core.config.safety import GateParameters
from flockd.core.messages import SECTORS, FloatArray, Setpoint
from flockd.flight.safety import Action, Gate, Objection, Permission, Surroundings, Verdict
from tests.make import around, request

STILL = (0.0, 0.0)
HOME = around()
DRAG_FREE = GateParameters().model_copy(update={"max_acceleration_m_s2": 1e6})
"""So that a step shows the limit it is about at once, of a drone that is not blown anywhere."""
FLIES = pytest.mark.parametrize("action", [Action.FLY, Action.FLY_DEGRADED])


class Stream:
    """A gate that is stepped at 20 Hz with fresh permissions."""

    def __init__(self, **limits: Any) -> None:
        self.gate = Gate(DRAG_FREE.model_copy(update=limits))
        self.now_s = 0.0

    def step(
        self,
        velocity: Sequence[float],
        action: Action = Action.FLY,
        near: Surroundings = HOME,
        height_m: float = 5.0,
        **fields: Any,
    ) -> Verdict:
        self.now_s += 0.05
        return self.gate.step(self.now_s, request(self.now_s, velocity, action, near, height_m=height_m, **fields))

    def second(self, velocity: Sequence[float], action: Action = Action.FLY, near: Surroundings = HOME) -> Verdict:
        """The second of two steps: the first one begins at the drone's own velocity."""
        self.step(velocity, action, near)
        return self.step(velocity, action, near)

    def velocities(
        self, count: int, velocity: Sequence[float], action: Action = Action.FLY, /, **near: Any
    ) -> list[Any]:
        """What is sent in so many steps."""
        return [sent(self.step(velocity, action, around(**near))).velocity.tolist() for _ in range(count)]

    def height(self, height_m: float, action: Action = Action.FLY, /, **near: Any) -> float:
        """What is sent where this height is asked for."""
        return sent(self.step(STILL, action, around(**near), height_m)).height_m


def sent(verdict: Verdict) -> Setpoint:
    assert verdict.setpoint is not None
    return verdict.setpoint


def left(verdict: Verdict, velocity: Sequence[float], *objections: Objection, atol: float = 1e-9) -> None:
    """Holds what is sent against this."""
    np.testing.assert_allclose(sent(verdict).velocity, velocity, atol=atol)
    assert verdict.objections == objections


def test_a_heading_and_a_height_that_are_not_asked_for_stay() -> None:
    """The heading is the drone's own before a first one was sent; the height is the one that the flight began at."""
    gate, near, flown = Gate(DRAG_FREE), around(height_m=6.0), []
    free = request(0.0, STILL, Action.FLY, near, yaw_rad=None, height_m=6.0)
    turned = replace(free, wanted=replace(free.wanted, yaw_rad=2.0, height_m=5.5))
    for tick, want in enumerate((free, turned, turned, free, free)):
        now_s = tick / 4
        verdict = gate.step(now_s, replace(want, permission=Permission(Action.FLY, now_s), wanted_s=now_s))
        assert verdict.objections == ()
        flown.append((sent(verdict).yaw_rad, sent(verdict).height_m))
    # 1.5 m/s of climb are 0.375 m in a quarter of a second.
    assert flown == [(0.5, 6.0), (2.0, 5.625), (2.0, 5.5), (2.0, 5.875), (2.0, 6.0)]


# Silence.


def test_a_command_within_all_limits_passes_as_it_is() -> None:
    verdict = Stream().second([0.6, -0.8])
    left(verdict, [0.6, -0.8])
    assert (sent(verdict).time_s, sent(verdict).height_m, sent(verdict).yaw_rad) == (0.1, 5.0, 1.0)


def test_it_is_silent_until_allowed() -> None:
    assert Stream().step([1.0, 0.0], Action.SILENCE) == Verdict(None, (Objection.NOT_ALLOWED,))


@pytest.mark.parametrize("action", sorted(set(Action) - {Action.SILENCE, Action.FLY, Action.FLY_DEGRADED}))
def test_all_other_actions_send_standstill_whatever_the_command(action: Action) -> None:
    for velocity, odd in (([1.0, 1.0], {}), ([math.nan, 99.0], {"yaw_rad": math.nan}), ([1, 1], {"wanted_s": -99})):
        verdict = Stream().step(velocity, action, **odd)
        left(verdict, STILL)
        assert sent(verdict).yaw_rad == 0.5  # as the drone looks


@pytest.mark.parametrize("action", [Action.FLY, Action.HOVER])
@pytest.mark.parametrize(
    ("age_s", "good"), [(0.25, True), (0.26, False), (-0.25, True), (-0.26, False), (math.nan, False)]
)
def test_a_permission_is_good_for_so_long(action: Action, age_s: float, good: bool) -> None:
    asked = replace(request(8.0, [1.0, 0.0]), permission=Permission(action, 8.0 - age_s))
    verdict = Gate(GateParameters(permission_timeout_s=0.25)).step(8.0, asked)
    assert (verdict.setpoint is not None) == good
    assert verdict.objections == (() if good else (Objection.PERMISSION_STALE,))


@FLIES
@pytest.mark.parametrize(
    ("age_s", "good"), [(1.5, True), (1.51, False), (-1.5, True), (-1.51, False), (math.nan, False)]
)
def test_a_command_is_good_for_so_long(action: Action, age_s: float, good: bool) -> None:
    verdict = Gate(DRAG_FREE).step(8.0, request(8.0, [1.0, 0.0], action, wanted_s=8.0 - age_s))
    assert (verdict.setpoint is not None) == good
    assert (verdict.objections == (Objection.COMMAND_STALE,)) is not good


@pytest.mark.parametrize("speed_m_s", [1.0, 3.0])
def test_after_the_pilots_last_output_the_drone_slows_down_and_stands_still_before_the_time_out(
    speed_m_s: float,
) -> None:
    """The last command is of 1.0 s; with a step of 0.5 s the next one is missed some time after 1.5 s."""
    gate, speeds = Gate(GateParameters()), {}
    for now_s in np.arange(70) / 20:
        setpoint = gate.step(now_s, request(now_s, [speed_m_s, 0.0], wanted_s=min(now_s, 1.0))).setpoint
        speeds[now_s] = None if setpoint is None else float(setpoint.velocity[0])
    assert speeds[1.9] == pytest.approx(speed_m_s)  # a pilot whose steps take 0.4 s is not slowed down
    assert speeds[2.2] == pytest.approx(speed_m_s / 2)  # half of the way from 0.9 s to 1.5 s
    assert speeds[2.5] == pytest.approx(0.0, abs=1e-9)
    assert speeds[2.55] is None


def test_a_daemon_that_stalls_is_silenced_in_time_for_the_half_second() -> None:
    gate, last = Gate(GateParameters()), request(0.05, [1.0, 0.0])
    heard_s = [now_s for now_s in np.arange(0.05, 2.0, 0.05) if gate.step(now_s, last).setpoint is not None]
    assert max(heard_s) - 0.05 < 0.5


# Numbers that cannot be.


@pytest.mark.fault("command-not-finite")
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_command_that_is_not_finite_is_refused_and_brings_standstill(bad: float) -> None:
    for velocity in ([bad, 0.5], [0.5, bad]):
        verdict = Stream().second(velocity)
        left(verdict, STILL, *verdict.objections)
        assert Objection.COMMAND_NOT_FINITE in verdict.objections


@pytest.mark.parametrize("yaw_rad", [math.nan, math.inf, -math.inf])
def test_a_heading_that_is_not_finite_costs_the_heading_only(yaw_rad: float) -> None:
    stream = Stream()
    stream.second([0.5, 0.0])
    verdict = stream.step([0.5, 0.0], yaw_rad=yaw_rad)
    left(verdict, [0.5, 0.0], Objection.HEADING_NOT_FINITE)
    assert sent(verdict).yaw_rad == 1.0, "the last one"
    assert sent(stream.step([0.5, 0.0], Action.HOVER)).yaw_rad == 1.0, "where it faced last"


def test_a_command_faster_than_any_may_be_is_refused_not_slowed() -> None:
    stream = Stream(max_speed_m_s=5.0)
    left(stream.second([3.0, 4.0]), [3.0, 4.0])
    left(stream.step([3.0, 4.01]), STILL, Objection.COMMAND_TOO_LARGE)
    left(Stream().second([30.0, 0.0], Action.FLY_DEGRADED), STILL, Objection.COMMAND_TOO_LARGE)


def test_refusals_are_counted() -> None:
    stream = Stream()
    for velocity in ([1.0, 0.0], [9.0, 0.0], [math.nan, 0.0], [9.0, 0.0]):
        stream.step(velocity)
    stream.step([1.0, 0.0], Action.SILENCE)
    assert stream.gate.counts == {
        Objection.COMMAND_TOO_LARGE: 2,
        Objection.COMMAND_NOT_FINITE: 1,
        Objection.NOT_ALLOWED: 1,
    }


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("action", [Action.FLY, Action.HOVER])
def test_without_a_height_to_hold_or_any_yaw_nothing_can_be_sent(bad: float, action: Action) -> None:
    nothing, lost = Verdict(None, (Objection.SETPOINT_NOT_FINITE,)), around(yaw_rad=bad)
    assert Stream().step([1.0, 0.0], action, height_m=bad) == nothing
    assert Stream().step([1.0, 0.0], Action.HOVER, lost) == nothing
    assert sent(Stream().step([1.0, 0.0], Action.FLY, lost)).yaw_rad == 1.0


@pytest.mark.parametrize("turns", [-40, -1, 1, 2, 1000])
def test_a_heading_that_has_turned_on_and_on_is_the_same_heading(turns: int) -> None:
    yaw_rad = 0.8 + 2 * math.pi * turns
    for verdict in (
        Stream().step([0.5, 0.0], yaw_rad=yaw_rad),
        Stream().step([1.0, 0.0], Action.HOVER, around(yaw_rad=yaw_rad)),
    ):
        assert verdict.objections == ()
        assert sent(verdict).yaw_rad == pytest.approx(0.8, abs=1e-9)


@pytest.mark.parametrize(
    ("near", "objection"),
    [
        ({"position": [0.0, math.nan]}, Objection.POSITION_UNKNOWN),
        ({"neighbours": [[9.0, 0.0, 0.0], [math.nan, 5.0, 0.0]]}, Objection.NEIGHBOUR_UNKNOWN),
        ({"neighbours": [[9.0, 0.0, math.inf]]}, Objection.NEIGHBOUR_UNKNOWN),
        ({"neighbours": [[9.0, 0, 0]], "neighbour_velocities": [[0.0, math.nan]]}, Objection.NEIGHBOUR_UNKNOWN),
        ({"neighbours": [[9.0, 0, 0]], "neighbour_margins": [[math.nan, 0.1]]}, Objection.NEIGHBOUR_UNKNOWN),
        ({"neighbours": [[9.0, 0, 0]], "neighbour_margins": [[0.1, math.nan]]}, Objection.NEIGHBOUR_UNKNOWN),
        ({"neighbours": [[9.0, 0, 0]], "neighbour_margins": [[-math.inf, 0.0]]}, Objection.NEIGHBOUR_UNKNOWN),
        ({"obstacles": [[5.0, 0.0], [math.nan, 1.0]]}, Objection.OBSTACLE_UNKNOWN),
        ({"obstacles": [[5.0, 0.0], [1.0, math.inf]]}, Objection.OBSTACLE_UNKNOWN),
    ],
)
def test_where_the_drone_a_neighbour_or_an_obstacle_is_not_known_it_stands_still(
    near: dict[str, Any], objection: Objection
) -> None:
    left(Stream().second([1.0, 0.0], near=around(**near)), STILL, objection)


def test_without_a_fence_the_position_does_not_matter() -> None:
    left(Stream(fence_radius_m=None).second([1.0, 0.0], near=around([math.nan, math.nan])), [1.0, 0.0])


# Speed and acceleration.


@FLIES
def test_an_old_command_is_reported_as_slowed_once(action: Action) -> None:
    verdict = Gate(DRAG_FREE).step(8.0, request(8.0, [3.0, 0.0], action, wanted_s=6.8))
    assert verdict.objections == (Objection.SLOWED,)


def test_degraded_it_flies_slower_and_says_so() -> None:
    stream = Stream(degraded_speed_m_s=1.0)
    left(stream.second([1.8, 2.4], Action.FLY_DEGRADED), [0.6, 0.8], Objection.SLOWED)
    left(stream.second([0.6, 0.8], Action.FLY_DEGRADED), [0.6, 0.8])


def test_from_standstill_it_gathers_speed_at_the_limit_and_brakes_at_it_and_begins_anew_after_silence() -> None:
    stream = Stream(max_acceleration_m_s2=2.0)
    # 2 m/s^2 * 0.05 s = 0.1 m/s more each step, from zero, until what was asked for
    rises = np.minimum(np.arange(13) / 10, 1.0)
    np.testing.assert_allclose(stream.velocities(13, [0.0, 1.0]), np.column_stack([0 * rises, rises]))
    np.testing.assert_allclose(stream.velocities(3, [0.0, 1.0], Action.HOVER), [[0, 0.9], [0, 0.8], [0, 0.7]])
    stream.step([0.0, 1.0], Action.SILENCE)
    assert stream.velocities(1, [0.0, 1.0]) == [[0.0, 0.0]]


@pytest.mark.parametrize(
    ("measured", "begins"),
    [((2.0, 0.0), (2.0, 0.0)), ((0.0, -9.0), (0.0, -4.0)), ((math.nan, 1.0), (0.0, 0.0))],
    ids=["its own", "the limit", "unknown"],
)
def test_it_takes_over_at_the_velocity_that_the_drone_has(
    measured: tuple[float, float], begins: tuple[float, float]
) -> None:
    flown = Stream(max_acceleration_m_s2=2.0).velocities(3, STILL, velocity=measured)
    slows = np.array([1.0, 0.95, 0.9])[:, None] if begins[0] else np.array([1.0, 0.975, 0.95])[:, None]
    np.testing.assert_allclose(flown, slows * begins)


def test_the_heading_that_is_offered_is_the_drones_own_at_each_instant() -> None:
    stream = Stream()
    for yaw_rad in (0.5, 1.2):
        assert sent(stream.step(STILL, Action.OFFER, around(yaw_rad=yaw_rad))).yaw_rad == yaw_rad


def test_a_streamer_that_paused_does_not_jump() -> None:
    stream = Stream(max_acceleration_m_s2=2.0, permission_timeout_s=0.25)
    stream.velocities(20, [1.0, 0.0])
    stream.now_s = 10.0
    assert stream.velocities(1, [1.0, 0.0]) == [[0.0, 0.0]]  # from the drone's own
    stream.now_s += 0.2  # 0.25 s later
    np.testing.assert_allclose(stream.velocities(1, [1.0, 0.0]), [[0.5, 0.0]])


def test_twice_at_one_instant_nothing_changes_nor_when_the_clock_is_read_late() -> None:
    gate = Gate(GateParameters())
    for now_s in (0.0, 0.05, 0.05, 0.04):
        velocity = sent(gate.step(now_s, request(now_s, [1.0, 0.0]))).velocity
    np.testing.assert_allclose(velocity, [0.25, 0.0])  # 5 m/s^2 for 0.05 s


# Heights.


def test_the_height_is_brought_into_the_band() -> None:
    for asked_m, sent_m in ((1.0, 2.0), (2.0, 2.0), (20.0, 20.0), (25.0, 20.0)):
        stream = Stream(min_height_m=2.0, max_height_m=20.0)
        verdict = stream.step(STILL, near=around(height_m=math.nan), height_m=asked_m)
        assert sent(verdict).height_m == sent_m
        assert verdict.objections == (() if asked_m == sent_m else (Objection.HEIGHT,))
    assert Stream(min_height_m=-50.0).height(-20.0, height_m=-20.0) == -20.0, "below home, alone"


def test_the_height_changes_at_the_limit_and_not_at_all_while_the_drone_stands_still() -> None:
    stream = Stream(max_climb_m_s=1.0)
    climbed = [stream.height(9.0) for _ in range(41)]
    np.testing.assert_allclose(climbed, 5.0 + 0.05 * np.arange(41))  # from the drone's own height, at 1 m/s
    assert stream.height(9.0, Action.HOVER) == pytest.approx(7.0)
    assert stream.height(5.0, Action.ASK_HOLD) == pytest.approx(7.0)
    assert stream.height(5.0, Action.FLY_DEGRADED) == pytest.approx(6.95)
    assert stream.height(6.94) == pytest.approx(6.94)
    stream.now_s += 0.31
    assert stream.height(5.0, height_m=7.0) == 7.0, "after silence from its own again"


def test_an_old_command_climbs_ever_slower() -> None:
    gate = Gate(GateParameters(max_climb_m_s=1.0, command_fresh_s=0.9, command_timeout_s=1.5))
    times_s = 0.05 * np.arange(31)
    heights = [sent(gate.step(t, request(t, STILL, height_m=9.0, wanted_s=0.0))).height_m for t in times_s]
    climbs = np.diff(heights) / 0.05
    np.testing.assert_allclose(climbs[:18], 1.0)
    np.testing.assert_allclose(climbs[23], 0.5)  # at 1.2 s, half way from 0.9 s to 1.5 s
    np.testing.assert_allclose(climbs[-1], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("above_m", "asked_m", "sent_m"),
    [
        (1.5, 6.0, 5.0),  # 1.5 m above is not free
        (0.5, 6.0, 5.0),
        (0.5, 4.0, 4.0),
        (-0.5, 4.0, 5.0),
        (-0.5, 6.0, 6.0),
        (0.0, 6.0, 6.0),
        (0.0, 4.0, 4.0),
        (2.9, 6.0, 5.0),
        (3.4, 6.0, 5.4),
        (1.5, 4.0, 4.0),  # away
        (-1.5, 4.0, 5.0),
        (-3.4, 4.0, 4.6),
        (-1.5, 6.0, 6.0),
        (4.0, 6.0, 6.0),
    ],
)
def test_no_change_of_height_leads_into_or_over_the_downwash_of_a_neighbour(
    above_m: float, asked_m: float, sent_m: float
) -> None:
    near, stream = around(neighbours=[[2.2, 0.0, -above_m]]), Stream(max_climb_m_s=20.0)
    stream.step(STILL, near=near)
    verdict = stream.step(STILL, near=near, height_m=asked_m)
    assert sent(verdict).height_m == pytest.approx(sent_m)
    assert verdict.objections == (() if sent_m == asked_m else (Objection.SEPARATION,))
    assert stream.height(asked_m, neighbours=[[2.25, 0.0, -above_m]]) == pytest.approx(asked_m), "beside"


def test_between_one_above_and_one_below_the_height_stays_and_does_not_creep() -> None:
    stream, both = Stream(), [[0.5, 0.0, -2.0], [0.0, 0.5, 2.0]]
    for step in range(200):
        own_m = 5.0 + 0.25 * math.sin(step)
        assert stream.height(5.0, neighbours=both, height_m=own_m) == pytest.approx(5.0, abs=1e-9)
    # Farther from what was asked for than by noise: no climb back.
    assert stream.height(5.0, neighbours=both, height_m=4.0) == pytest.approx(4.3)
    stream = Stream()
    stream.height(5.0, neighbours=both)
    assert stream.height(5.0, neighbours=both, height_m=6.0) == pytest.approx(5.7)


def test_without_a_height_of_its_own_a_drone_counts_as_where_it_was_asked_to_be() -> None:
    stream = Stream()
    for asked_m, sent_m in ((5.0, 5.0), (6.0, 5.0), (4.9, 4.925)):
        found_m = stream.height(asked_m, neighbours=[[1.0, 0.0, -1.5]], height_m=math.nan)
        assert found_m == pytest.approx(sent_m)


# Fence, neighbours and obstacles: what is left of a velocity.

SQUARE = {"fence_corners_m": ((-10.0, -10.0), (-10.0, 10.0), (10.0, 10.0), (10.0, -10.0)), "fence_radius_m": None}
FENCE, SEPARATION, OBSTACLE = (Objection.FENCE,), (Objection.SEPARATION,), (Objection.OBSTACLE,)
UNSEEN = (Objection.UNSEEN,)
BEYOND = {"position": [101.0, 0.0]}
AHEAD_AND_RIGHT = {"neighbours": [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]]}


def seen(range_m: float, *sectors: int) -> FloatArray:
    """So far in these sectors, of 5 degrees from north on, and as far as can be in all others."""
    seen_m = np.full(SECTORS, np.inf)
    seen_m[list(sectors)] = range_m
    return seen_m


GAP = [(0.1 * k, side) for k in range(-20, 21) for side in (-0.9, 0.9)]


@pytest.mark.parametrize(
    ("asked", "near", "expected", "objections"),
    [
        pytest.param([1.0, 0.5], BEYOND, STILL, FENCE, id="outside the fence outward"),
        pytest.param([-1.0, 0.5], BEYOND, [-1.0, 0.0], FENCE, id="outside the fence inward"),
        # 2 m before it, of which 0.6 m are kept: 0.5 v + v^2 / 3 = 1.4 m
        pytest.param([1.0, 0.5], {"position": [98.0, 0.0]}, [1.0, 0.5], (), id="slowly at the fence"),
        pytest.param(
            [2.0, 0.5], {"position": [98, 0]}, [math.sqrt(0.5625 + 4.2) - 0.75, 0.5], FENCE, id="fast at the fence"
        ),
        pytest.param(
            [-1.0, 1.0], BEYOND | {"neighbours": [[0.5, 0.0, 0.0]]}, [-1.0, 0.0], FENCE, id="back, away from one"
        ),
        pytest.param(
            [1.0, 1.0], BEYOND | {"neighbours": [[0.0, 0.5, 0.0]]}, STILL, FENCE + SEPARATION, id="fence and neighbour"
        ),
        *(
            pytest.param([1.0, 0.5], {"neighbours": [[0.9, 0.0, down_m]]}, [0.0, 0.5], SEPARATION, id=f"{down_m} below")
            for down_m in (0.0, 1.5, 2.9, -1.5, -2.9)
        ),
        *(
            pytest.param([1.0, 0.5], {"neighbours": [place]}, [1.0, 0.5], (), id=f"neighbour {place}")
            for place in ([-0.9, 0, 0], [4.0, 0, 0], [0.7, 0, 3.0], [0.7, 0, -3.0], [0, 0, -0.5], [1e-163, 0, 0],
                          [0.099, 0, 0])
        ),
        pytest.param([1.0, 0.5], AHEAD_AND_RIGHT, STILL, SEPARATION, id="towards two neighbours"),
        pytest.param([1.0, -0.5], AHEAD_AND_RIGHT, [0.0, -0.5], SEPARATION, id="between two neighbours"),
        pytest.param([2.0, 0.0], {"obstacles": [[10.0, 0.0], [0.0, 0.7]]}, [2.0, 0.0], (), id="far from obstacles"),
        *(
            pytest.param([2.0, 1.0], {"obstacles": [[away_m, 0.0]]}, [0.0, 1.0], OBSTACLE, id=f"obstacle at {away_m} m")
            for away_m in (0.6, 0.3, 1e-3)
        ),
        pytest.param([-2.0, 0.5], {"obstacles": [[0.2, 0.0]]}, [-2.0, 0.5], (), id="away from an obstacle"),
        # 1 m before it, of which 0.6 m are kept: 0.5 v + v^2 / 3 = 0.4 m
        pytest.param(
            [3.0, 0.0], {"obstacles": [[1.0, 0.0]]}, [math.sqrt(1.7625) - 0.75, 0.0], OBSTACLE, id="at an obstacle"
        ),
        pytest.param([1.0, 0.0], {"obstacles": GAP}, [1.0, 0.0], (), id="through the middle of a gap"),
        # 2.5 m of 3.5 m are left before one that may hover there: v + v^2 / 3 = 2.5 m
        *(
            pytest.param([0.0, 3.0], {"seen_m": seen(3.5, *where)}, [0.0, most], UNSEEN, id=f"unseen {where}")
            for where in ([18], [17], [19]) for most in [1.5 * (math.sqrt(1.0 + 10.0 / 3.0) - 1.0)]
        ),
        pytest.param([0.0, 3.0], {"seen_m": seen(0.0, 16, 20)}, [0.0, 3.0], (), id="unseen on both sides"),
        pytest.param([-1.0, -1.0], {"seen_m": seen(1.0, 45)}, STILL, UNSEEN, id="not seen behind"),
        pytest.param([0.0, 3.0], {"seen_m": seen(math.nan, 18)}, STILL, UNSEEN, id="not known to be seen"),
        pytest.param(
            [-1.0, 0.0], {"seen_m": seen(0.0, 36), "neighbours": [[0.9, 0.0, 0.0]]}, [-1.0, 0.0], (),
            id="from a neighbour to where nobody looks",
        ),
        pytest.param(
            [-1.0, 0.0], {"seen_m": seen(0.0, 36), "obstacles": [[0.5, 0.0]]}, [-1.0, 0.0], (),
            id="from an obstacle to where nobody looks",
        ),
        pytest.param(
            [-1.0, 0.0], {"seen_m": seen(0.0, 36), "neighbours": [[1.1, 0, 0]], "obstacles": [[0.7, 0]]}, STILL, UNSEEN,
            id="not from those that are not too near",
        ),
        pytest.param(
            [1.0, 1.0], {"obstacles": [[0.4, 0.0]], "neighbours": [[0.0, 0.9, 0.0]]}, STILL, SEPARATION + OBSTACLE,
            id="neighbour and obstacle",
        ),
    ],
)  # fmt: skip
def test_what_leads_too_fast_anywhere_is_taken_off(
    asked: list[float], near: dict[str, Any], expected: list[float], objections: tuple[Objection, ...]
) -> None:
    left(Stream().second(asked, near=around(**near)), expected, *objections)


def test_beyond_the_corner_of_a_fence_only_the_way_back_is_left() -> None:
    corner = around([11.0, 11.0])
    left(Stream(**SQUARE).second([1.0, 0.0], near=corner), [0.5, -0.5], *FENCE)  # what of it is not along (1, 1)


def test_a_drone_that_stands_still_may_stay_beside_an_obstacle() -> None:
    left(Stream().second([1.0, 0.0], Action.HOVER, around(obstacles=[[0.1, 0.0]])), STILL)


def test_degraded_it_keeps_farther_away() -> None:
    stream = {"degraded_separation_m": 1.5, "neighbour_reaction_s": 0.5}
    for action, velocity in ((Action.FLY, [0.2, 0.5]), (Action.FLY_DEGRADED, [0.0, 0.5])):
        verdict = Stream(**stream).second([0.2, 0.5], action, around(neighbours=[[1.4, 0.0, 0.0]]))
        np.testing.assert_allclose(sent(verdict).velocity, velocity)
    moving = Stream(**stream).velocities(1, STILL, Action.HOVER, neighbours=[[1.4, 0, 0]], velocity=[1.0, 0.0])
    np.testing.assert_allclose(moving, [[0.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize(
    ("asked", "range_m", "theirs", "fastest"),
    [
        # 3 m to the minimum distance of 1 m. Both at 1.65 m/s: half a second takes 1.65 m, braking 2 * 1.65^2 / 4 m.
        pytest.param([3.5, 0.5], 4.0, [0.0, 0.0], [1.6458, 0.5], id="stands"),
        # 1 m for its half second and 1 m to brake; 1 m is left for 0.5 s and the braking from 1.24 m/s.
        pytest.param([3.5, 0.0], 4.0, [-2.0, 0.3], [1.2361, 0.0], id="comes at 2 m/s"),
        pytest.param([3.5, 0.0], 4.0, [-4.0, 0.0], STILL, id="needs all of the 3 m and more"),
        # It may stop at once, and 1 cm is left: v 0.5 + v^2 / 4.
        pytest.param([2.0, 0.0], 1.01, [2.0, 0.0], [0.0198, 0.0], id="ahead, as fast"),
        pytest.param([1.0, 0.0], 2.5, [-3.0, 0.0], STILL, id="comes faster than both can brake"),
    ],
)
def test_towards_a_neighbour_it_flies_no_faster_than_it_can_brake(
    asked: list[float], range_m: float, theirs: list[float], fastest: Sequence[float]
) -> None:
    near = around(neighbours=[[range_m, 0.0, 0.0]], neighbour_velocities=[theirs])
    verdict = Stream(braking_m_s2=2.0, neighbour_reaction_s=0.5).second(asked, near=near)
    left(verdict, fastest, *(SEPARATION if asked != fastest else ()), atol=1e-4)


def test_an_uncertain_neighbour_counts_as_nearer_and_faster() -> None:
    """4 m with a margin of 0.5 m is 3.5 m, and 1 m/s towards the drone with one of 1 m/s are 2 m/s."""

    def fastest(range_m: float, north_m_s: float, **margins: Any) -> float:
        near = around(neighbours=[[range_m, 0, 0]], neighbour_velocities=[[north_m_s, 0.0]], **margins)
        return float(sent(Stream(neighbour_reaction_s=0.2).second([3.5, 0.0], near=near)).velocity[0])

    exact = fastest(3.5, -2.0)
    assert 0.3 < exact < 3.0
    assert fastest(4.0, -1.0, neighbour_margins=[[0.5, 1.0]]) == pytest.approx(exact)
    # A flock mate that flies ahead is followed by its likeliest velocity: doubt about it holds nobody back.
    assert fastest(4.0, 1.0, neighbour_margins=[[0.2, 0.4]]) >= 1.0


def test_a_drone_that_follows_late_keeps_room_for_that_too() -> None:
    """As one that is configured to react so much later, before neighbours as before obstacles."""
    places: list[dict[str, Any]] = [
        {"neighbours": [[4.0, 0.0, 0.0]], "neighbour_velocities": [[-1.0, 0.0]]}, {"obstacles": [[3.0, 0.0]]},
    ]  # fmt: skip
    for place in places:
        late, slow, prompt = (Stream(reaction_s=r, neighbour_reaction_s=r) for r in (0.5, 1.0, 0.5))
        for one in (late, slow, prompt):
            one.step([2.5, 0.0], near=around(**place))
        late.gate.response.late_s = 0.5
        assert late.gate.response.late_s == 0.5
        a, b, c = (sent(one.step([2.5, 0.0], near=around(**place))).velocity[0] for one in (late, slow, prompt))
        assert a == pytest.approx(b)
        assert a < c - 0.1


@pytest.mark.fault("neighbour-too-near")
@pytest.mark.parametrize(("lag_s", "period_s", "least_m"), [(0.0, 0.05, 1.0), (0.35, 0.5, 0.999)])
def test_two_that_fly_at_each_other_at_3_m_s_stop_before_the_minimum_distance(
    lag_s: float, period_s: float, least_m: float
) -> None:
    """Point masses, 20 m apart, that brake at 5 m/s^2; then ones that lag too, and see each other twice a second."""
    gates = [Stream(max_acceleration_m_s2=5.0), Stream(max_acceleration_m_s2=5.0)]
    places, velocities = np.array([[0.0, 0.0], [20.0, 0.0]]), np.array([[3.0, 0.0], [-3.0, 0.0]])
    seen, seen_velocities, nearest_m = places, velocities, 20.0
    for step in range(400):
        if step % round(period_s / 0.05) == 0:
            seen, seen_velocities, seen_s = places, velocities, step * 0.05
        setpoints = np.zeros((2, 2))
        for me, other in ((0, 1), (1, 0)):
            offset = seen[other] + seen_velocities[other] * (step * 0.05 - seen_s) - places[me]
            near = around(
                places[me], velocities[me], neighbours=[[*offset, 0.0]], neighbour_velocities=seen_velocities[[other]]
            )
            setpoints[me] = sent(gates[me].step([3.0 - 6.0 * me, 0.0], near=near)).velocity
        for _ in range(5):
            change = (setpoints - velocities) * (1.0 if lag_s == 0.0 else 0.01 / lag_s)
            velocities = velocities + np.clip(change, -0.05, 0.05)  # 5 m/s^2 for 0.01 s
            places = places + 0.01 * velocities
            nearest_m = min(nearest_m, float(np.linalg.norm(places[1] - places[0])))
    assert least_m <= nearest_m < 1.3


def test_separation_wins_over_the_acceleration_limit() -> None:
    stream = Stream(max_acceleration_m_s2=2.0)
    stream.velocities(20, [1.0, 0.0])
    np.testing.assert_allclose(stream.velocities(1, [1.0, 0.0], neighbours=[[0.9, 0, 0]]), [[0, 0]], atol=1e-12)


def test_a_takeover_in_motion_begins_at_the_velocity_that_the_drone_has() -> None:
    """PX4 wants a stream before offboard: it carries what a person flies, 4 m/s, which then falls by 0.2 m/s a tick."""
    gate, north_m_s = Gate(GateParameters()), []
    for tick in range(24):
        action = Action.OFFER if tick < 20 else Action.FLY
        verdict = gate.step(0.05 * tick, request(0.05 * tick, STILL, action, around(velocity=[4.0, 0.0])))
        north_m_s.append(sent(verdict).velocity[0])
    most_m_s = GateParameters().max_speed_m_s
    assert north_m_s[:20] == [min(4.0, most_m_s)] * 20
    fall = 0.05 * GateParameters().max_acceleration_m_s2
    assert north_m_s[20:] == pytest.approx([north_m_s[19] - k * fall for k in range(1, 5)])


def test_a_takeover_far_from_the_height_to_fly_at_begins_at_the_height_that_the_drone_has() -> None:
    """With `autopilot.height_m` 20 at 3 m: PX4 climbs by 1 m/s for each metre that a setpoint is above the drone."""
    stream, actions = Stream(max_climb_m_s=1.5), [Action.OFFER] * 20 + [Action.FLY] * 4
    heights_m = [stream.height(20.0, action, height_m=3.0) for action in actions]
    assert heights_m == pytest.approx([3.0] * 20 + [3.075, 3.15, 3.225, 3.3])


@pytest.mark.parametrize("action", [Action.HOVER, Action.ASK_HOLD, Action.FLY])
def test_a_margin_that_is_not_a_number_stops_and_raises_nothing(action: Action) -> None:
    near = around(neighbours=[[3.0, 0.0, 0.0]], neighbour_margins=[[0.1, math.nan]])
    assert sent(Stream().second([1.0, 0.0], action, near)).velocity.tolist() == [0.0, 0.0]


def test_what_may_be_farther_than_it_seems_is_known_and_what_may_be_anywhere_is_not() -> None:
    for margin, known in ((-0.1, True), (-math.inf, False), (math.nan, False)):
        near = around(neighbours=[[9.0, 0.0, 0.0]], neighbour_margins=[[margin, margin]])
        assert (Objection.NEIGHBOUR_UNKNOWN not in Stream().step(STILL, near=near).objections) is known


@pytest.mark.parametrize("velocity", [(math.nan, 1.0), (math.nan, math.nan)])
def test_a_drone_that_does_not_know_its_velocity_begins_at_standstill(velocity: tuple[float, float]) -> None:
    gate = Gate(GateParameters(fence_radius_m=None))
    verdict = gate.step(0.0, request(0.0, (1.0, 0.0), surroundings=around(velocity=velocity)))
    assert sent(verdict).velocity.tolist() == [0.0, 0.0]


def test_a_vehicle_that_follows_late_is_flown_as_one_that_reacts_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the end of the limits: before a neighbour that comes."""
    near = around(neighbours=[[8.0, 0.0, 0.0]], neighbour_velocities=[[-2.0, 0.0]])
    late, slow = Stream(), Stream(reaction_s=1.0, neighbour_reaction_s=DRAG_FREE.neighbour_reaction_s + 0.5)
    late.gate.response.late_s = 0.5
    monkeypatch.setattr(late.gate.response, "restart", lambda _: None)
    velocities = [sent(one.second([3.0, 0.0], near=near)).velocity[0] for one in (late, slow)]
    assert velocities[0] == pytest.approx(velocities[1])
    assert 0.0 < velocities[0] < sent(Stream().second([3.0, 0.0], near=near)).velocity[0]

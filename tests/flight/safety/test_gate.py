"""The last gate: what passes, what is made smaller, what is refused; by hand and with random numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from flockd.core.messages import FloatArray, Setpoint, Wanted
from flockd.flight.safety import Action, Gate, GateParameters, Objection, Permission, Request, Surroundings, Verdict

STILL = np.zeros(2)
NOBODY = np.empty((0, 3))
DRAG_FREE = GateParameters().model_copy(update={"max_acceleration_m_s2": 1e6})
"""So that a step shows the limit it is about at once, of a drone that is not blown anywhere."""
HOME = Surroundings(
    position=STILL,
    velocity=STILL,
    yaw_rad=0.5,
    neighbours=NOBODY,
    neighbour_velocities=NOBODY[:, :2],
    height_m=5.0,
)


def wanted(velocity: ArrayLike, *, time_s: float = 0.0, height_m: float = 5.0, yaw_rad: float = 1.0) -> Request:
    """A request without permission, far from everybody."""
    want = Wanted(np.asarray(velocity, dtype=float), np.zeros(2), yaw_rad)
    return Request(Permission(Action.SILENCE, 0.0), want, time_s, height_m, HOME)


def judge(gate: Gate, now_s: float, permission: Permission, want: Request, around: Surroundings = HOME) -> Verdict:
    return gate.step(now_s, replace(want, permission=permission, around=around))


class Stream:
    """A gate that is stepped at 20 Hz with fresh permissions."""

    def __init__(self, parameters: GateParameters | None = None) -> None:
        self.gate = Gate(parameters or DRAG_FREE)
        self.now_s = 0.0

    def step(
        self, velocity: ArrayLike, action: Action = Action.FLY, around: Surroundings = HOME, height_m: float = 5.0
    ) -> Verdict:
        self.now_s += 0.05
        permission = Permission(action, self.now_s)
        return judge(self.gate, self.now_s, permission, wanted(velocity, time_s=self.now_s, height_m=height_m), around)

    def second(self, velocity: ArrayLike, action: Action = Action.FLY, around: Surroundings = HOME) -> Verdict:
        """The second of two steps: the first one begins at the drone's own velocity."""
        self.step(velocity, action, around)
        return self.step(velocity, action, around)


def sent(verdict: Verdict) -> Setpoint:
    assert verdict.setpoint is not None
    return verdict.setpoint


def near(*neighbours: ArrayLike) -> Surroundings:
    """Neighbours that stand still."""
    return replace(
        HOME, neighbours=np.array(neighbours, dtype=float), neighbour_velocities=np.zeros((len(neighbours), 2))
    )


def test_a_heading_and_a_height_that_are_not_asked_for_stay() -> None:
    """The heading is the drone's own before a first one was sent; the height is the one that the flight began at."""
    gate = Gate(DRAG_FREE)
    free = replace(wanted([0.0, 0.0], height_m=6.0), wanted=Wanted(STILL, STILL, None))
    turned = replace(wanted([0.0, 0.0], height_m=6.0), wanted=Wanted(STILL, STILL, 2.0, height_m=5.5))
    around, flown = replace(HOME, height_m=6.0), []
    for tick, want in enumerate((free, turned, turned, free, free)):
        now_s = tick / 4
        verdict = judge(gate, now_s, Permission(Action.FLY, now_s), replace(want, wanted_s=now_s), around)
        assert verdict.objections == ()
        flown.append((sent(verdict).yaw_rad, sent(verdict).height_m))
    # 1.5 m/s of climb are 0.375 m in a quarter of a second.
    assert flown == [(0.5, 6.0), (2.0, 5.625), (2.0, 5.5), (2.0, 5.875), (2.0, 6.0)]


# Silence.


def test_a_command_within_all_limits_passes_as_it_is() -> None:
    verdict = Stream().second([0.6, -0.8])
    setpoint = sent(verdict)
    np.testing.assert_allclose(setpoint.velocity, [0.6, -0.8])
    assert (setpoint.time_s, setpoint.height_m, setpoint.yaw_rad) == (0.1, 5.0, 1.0)
    assert verdict.objections == ()


def test_it_is_silent_until_allowed() -> None:
    verdict = judge(Gate(DRAG_FREE), 0.0, Permission(Action.SILENCE, 0.0), wanted([1.0, 0.0]), HOME)
    assert verdict == Verdict(None, (Objection.NOT_ALLOWED,))


@pytest.mark.parametrize("action", sorted(set(Action) - {Action.SILENCE, Action.FLY, Action.FLY_DEGRADED}))
def test_all_other_actions_send_standstill_whatever_the_command(action: Action) -> None:
    for want in (
        wanted([1.0, 1.0]),
        wanted([math.nan, 99.0], yaw_rad=math.nan),
        wanted([1, 1], time_s=-99),
    ):
        verdict = judge(Gate(DRAG_FREE), 0.0, Permission(action, 0.0), want, HOME)
        np.testing.assert_array_equal(sent(verdict).velocity, STILL)
        assert sent(verdict).yaw_rad == 0.5  # as the drone looks
        assert verdict.objections == ()


@pytest.mark.parametrize("action", [Action.FLY, Action.HOVER])
@pytest.mark.parametrize(
    ("age_s", "good"), [(0.25, True), (0.26, False), (-0.25, True), (-0.26, False), (math.nan, False)]
)
def test_a_permission_is_good_for_so_long(action: Action, age_s: float, good: bool) -> None:
    gate = Gate(GateParameters(permission_timeout_s=0.25))
    verdict = judge(gate, 8.0, Permission(action, 8.0 - age_s), wanted([1.0, 0.0], time_s=8.0), HOME)
    assert (verdict.setpoint is not None) == good
    assert verdict.objections == (() if good else (Objection.PERMISSION_STALE,))


@pytest.mark.parametrize("action", [Action.FLY, Action.FLY_DEGRADED])
@pytest.mark.parametrize(
    ("age_s", "good"), [(1.5, True), (1.51, False), (-1.5, True), (-1.51, False), (math.nan, False)]
)
def test_a_command_is_good_for_so_long(action: Action, age_s: float, good: bool) -> None:
    verdict = judge(Gate(DRAG_FREE), 8.0, Permission(action, 8.0), wanted([1.0, 0.0], time_s=8.0 - age_s), HOME)
    assert (verdict.setpoint is not None) == good
    assert (verdict.objections == (Objection.COMMAND_STALE,)) is not good


@pytest.mark.parametrize("speed_m_s", [1.0, 3.0])
def test_after_the_pilots_last_output_the_drone_slows_down_and_stands_still_before_the_time_out(
    speed_m_s: float,
) -> None:
    """The last command is of 1.0 s; with a step of 0.5 s the next one is missed some time after 1.5 s."""
    gate, speeds = Gate(GateParameters()), {}
    for tick in range(0, 70):
        now_s = tick / 20
        command = wanted([speed_m_s, 0.0], time_s=min(now_s, 1.0))
        setpoint = judge(gate, now_s, Permission(Action.FLY, now_s), command, HOME).setpoint
        speeds[now_s] = None if setpoint is None else float(setpoint.velocity[0])
    assert speeds[1.9] == pytest.approx(speed_m_s)  # a pilot whose steps take 0.4 s is not slowed down
    assert speeds[2.2] == pytest.approx(speed_m_s / 2)  # half of the way from 0.9 s to 1.5 s
    assert speeds[2.5] == pytest.approx(0.0, abs=1e-9)
    assert speeds[2.55] is None


def test_a_daemon_that_stalls_is_silenced_in_time_for_the_half_second() -> None:
    stream = Stream(GateParameters())
    stream.step([1.0, 0.0])
    last = Permission(Action.FLY, stream.now_s)
    heard_s = [
        now_s
        for now_s in np.arange(0.05, 2.0, 0.05)
        if judge(stream.gate, now_s, last, wanted([1.0, 0.0], time_s=0.05), HOME).setpoint is not None
    ]
    assert max(heard_s) - last.time_s < 0.5


# Numbers that cannot be.


@pytest.mark.fault("command-not-finite")
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_command_that_is_not_finite_is_refused_and_brings_standstill(bad: float, axis: int) -> None:
    velocity = np.array([0.5, 0.5])
    velocity[axis] = bad
    verdict = Stream().second(velocity)
    np.testing.assert_array_equal(sent(verdict).velocity, STILL)
    assert Objection.COMMAND_NOT_FINITE in verdict.objections


@pytest.mark.parametrize("yaw_rad", [math.nan, math.inf, -math.inf])
def test_a_heading_that_is_not_finite_costs_the_heading_only(yaw_rad: float) -> None:
    stream = Stream()
    stream.second([0.5, 0.0])
    want = wanted([0.5, 0.0], time_s=stream.now_s, yaw_rad=yaw_rad)
    verdict = judge(stream.gate, stream.now_s, Permission(Action.FLY, stream.now_s), want, HOME)
    np.testing.assert_allclose(sent(verdict).velocity, [0.5, 0.0])
    assert sent(verdict).yaw_rad == 1.0, "the last one"
    assert verdict.objections == (Objection.HEADING_NOT_FINITE,)
    assert stream.gate.counts == {Objection.HEADING_NOT_FINITE: 1}


def test_standing_still_it_faces_where_it_faced_last() -> None:
    stream = Stream()
    stream.second([0.5, 0.0])
    assert sent(stream.step([0.5, 0.0], Action.HOVER)).yaw_rad == 1.0


def test_a_command_faster_than_any_may_be_is_refused_not_slowed() -> None:
    stream = Stream(DRAG_FREE.model_copy(update={"max_speed_m_s": 5.0}))
    verdict = stream.second([3.0, 4.0])
    np.testing.assert_allclose(sent(verdict).velocity, [3.0, 4.0])
    assert verdict.objections == ()
    verdict = stream.step([3.0, 4.01])
    np.testing.assert_allclose(sent(verdict).velocity, STILL, atol=1e-12)
    assert verdict.objections == (Objection.COMMAND_TOO_LARGE,)


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


@pytest.mark.parametrize("height_m", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("action", [Action.FLY, Action.HOVER])
def test_without_a_height_to_hold_nothing_can_be_sent(height_m: float, action: Action) -> None:
    verdict = Stream().step([1.0, 0.0], action, height_m=height_m)
    assert verdict == Verdict(None, (Objection.SETPOINT_NOT_FINITE,))


@pytest.mark.parametrize("turns", [-40, -1, 1, 2, 1000])
def test_a_heading_that_has_turned_on_and_on_is_the_same_heading(turns: int) -> None:
    gate, fly, yaw_rad = Gate(DRAG_FREE), Permission(Action.FLY, 0.0), 0.8 + 2 * math.pi * turns
    verdict = judge(gate, 0.0, fly, wanted([0.5, 0.0], yaw_rad=yaw_rad))
    assert verdict.objections == ()
    assert sent(verdict).yaw_rad == pytest.approx(0.8, abs=1e-9)
    turned = Stream().step([1.0, 0.0], Action.HOVER, replace(HOME, yaw_rad=yaw_rad))
    assert sent(turned).yaw_rad == pytest.approx(0.8, abs=1e-9)


def test_without_any_yaw_nothing_can_be_sent() -> None:
    lost = replace(HOME, yaw_rad=math.nan)
    verdict = Stream().step([1.0, 0.0], Action.HOVER, lost)
    assert verdict == Verdict(None, (Objection.SETPOINT_NOT_FINITE,))
    assert sent(Stream().step([1.0, 0.0], Action.FLY, lost)).yaw_rad == 1.0


@pytest.mark.parametrize(
    ("around", "objection"),
    [
        (replace(HOME, position=np.array([0.0, math.nan])), Objection.POSITION_UNKNOWN),
        (near([9.0, 0.0, 0.0], [math.nan, 5.0, 0.0]), Objection.NEIGHBOUR_UNKNOWN),
        (near([9.0, 0.0, math.inf]), Objection.NEIGHBOUR_UNKNOWN),
        (replace(near([9.0, 0.0, 0.0]), neighbour_velocities=np.array([[0.0, math.nan]])), Objection.NEIGHBOUR_UNKNOWN),
    ],
)
def test_where_the_drone_or_a_neighbour_is_not_known_it_stands_still(
    around: Surroundings, objection: Objection
) -> None:
    verdict = Stream().second([1.0, 0.0], around=around)
    np.testing.assert_array_equal(sent(verdict).velocity, STILL)
    assert verdict.objections == (objection,)


def test_without_a_fence_the_position_does_not_matter() -> None:
    free = DRAG_FREE.model_copy(update={"fence_radius_m": None})
    verdict = Stream(free).second([1.0, 0.0], around=replace(HOME, position=np.full(2, math.nan)))
    np.testing.assert_allclose(sent(verdict).velocity, [1.0, 0.0])
    assert verdict.objections == ()


# Speed and acceleration.


def test_an_old_command_is_reported_as_slowed_once() -> None:
    gate = Gate(DRAG_FREE)
    for action in (Action.FLY, Action.FLY_DEGRADED):
        verdict = judge(gate, 8.0, Permission(action, 8.0), wanted([3.0, 0.0], time_s=6.8), HOME)
        assert verdict.objections == (Objection.SLOWED,)


def test_degraded_it_flies_slower_and_says_so() -> None:
    stream = Stream(DRAG_FREE.model_copy(update={"degraded_speed_m_s": 1.0}))
    verdict = stream.second([1.8, 2.4], Action.FLY_DEGRADED)
    np.testing.assert_allclose(sent(verdict).velocity, [0.6, 0.8])
    assert verdict.objections == (Objection.SLOWED,)
    verdict = stream.second([0.6, 0.8], Action.FLY_DEGRADED)
    np.testing.assert_allclose(sent(verdict).velocity, [0.6, 0.8])
    assert verdict.objections == ()


def test_degraded_a_command_too_large_is_refused_all_the_same() -> None:
    verdict = Stream().second([30.0, 0.0], Action.FLY_DEGRADED)
    np.testing.assert_array_equal(sent(verdict).velocity, STILL)
    assert verdict.objections == (Objection.COMMAND_TOO_LARGE,)


def test_from_standstill_it_gathers_speed_at_the_limit() -> None:
    stream = Stream(GateParameters(max_acceleration_m_s2=2.0))
    speeds = [sent(stream.step([0.0, 1.0])).velocity[1] for _ in range(13)]
    # 2 m/s^2 * 0.05 s = 0.1 m/s more each step, from zero, until what was asked for
    np.testing.assert_allclose(speeds, [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.0, 1.0])


def test_it_brakes_at_the_limit_too() -> None:
    stream = Stream(GateParameters(max_acceleration_m_s2=2.0))
    for _ in range(20):
        stream.step([1.0, 0.0])
    speeds = [sent(stream.step([1.0, 0.0], Action.HOVER)).velocity[0] for _ in range(3)]
    np.testing.assert_allclose(speeds, [0.9, 0.8, 0.7])


def test_it_takes_over_at_the_velocity_that_the_drone_has() -> None:
    moving = replace(HOME, velocity=np.array([2.0, 0.0]))
    stream = Stream(GateParameters(max_acceleration_m_s2=2.0))
    velocities = [sent(stream.step([0.0, 0.0], around=moving)).velocity[0] for _ in range(3)]
    np.testing.assert_allclose(velocities, [2.0, 1.9, 1.8])


def test_a_drone_faster_than_the_limit_is_taken_over_at_the_limit() -> None:
    moving = replace(HOME, velocity=np.array([0.0, -9.0]))
    np.testing.assert_allclose(sent(Stream(GateParameters()).step([0.0, 0.0], around=moving)).velocity, [0.0, -4.0])


def test_an_unknown_velocity_of_its_own_counts_as_none() -> None:
    lost = replace(HOME, velocity=np.array([math.nan, 1.0]))
    np.testing.assert_array_equal(sent(Stream(GateParameters()).step([1.0, 0.0], around=lost)).velocity, STILL)


def test_after_silence_it_starts_again_from_the_velocity_that_the_drone_has() -> None:
    stream = Stream(GateParameters(max_acceleration_m_s2=2.0))
    for _ in range(20):
        stream.step([1.0, 0.0])
    stream.step([1.0, 0.0], Action.SILENCE)
    np.testing.assert_allclose(sent(stream.step([1.0, 0.0])).velocity, STILL)


def test_a_streamer_that_paused_does_not_jump() -> None:
    parameters = GateParameters(max_acceleration_m_s2=2.0, permission_timeout_s=0.25)
    stream = Stream(parameters)
    for _ in range(20):
        stream.step([1.0, 0.0])
    stream.now_s = 10.0
    np.testing.assert_allclose(sent(stream.step([1.0, 0.0])).velocity, STILL)  # from the drone's own
    stream.now_s += 0.2  # 0.25 s later
    np.testing.assert_allclose(sent(stream.step([1.0, 0.0])).velocity, [0.5, 0.0])


def test_twice_at_one_instant_nothing_changes_nor_when_the_clock_is_read_late() -> None:
    gate = Gate(GateParameters())
    for now_s in (0.0, 0.05, 0.05, 0.04):
        velocity = sent(
            judge(gate, now_s, Permission(Action.FLY, now_s), wanted([1.0, 0.0], time_s=now_s), HOME)
        ).velocity
    np.testing.assert_allclose(velocity, [0.25, 0.0])  # 5 m/s^2 for 0.05 s


# Fence and heights.


def test_outside_the_fence_only_what_leads_inward_or_along_it_is_left() -> None:
    outside = replace(HOME, position=np.array([101.0, 0.0]))
    verdict = Stream().second([1.0, 0.5], around=outside)
    np.testing.assert_allclose(sent(verdict).velocity, [0.0, 0.5])
    assert verdict.objections == (Objection.FENCE,)
    verdict = Stream().second([-1.0, 0.5], around=outside)
    np.testing.assert_allclose(sent(verdict).velocity, [-1.0, 0.5])
    assert verdict.objections == ()
    inside = replace(HOME, position=np.array([98.0, 0.0]))  # 2 m, of which 0.6 m are kept: 0.5 v + v^2 / 3 = 1.4 m
    np.testing.assert_allclose(sent(Stream().second([1.0, 0.5], around=inside)).velocity, [1.0, 0.5])
    verdict = Stream().second([2.0, 0.5], around=inside)
    np.testing.assert_allclose(sent(verdict).velocity, [math.sqrt(0.5625 + 3.0 * 1.4) - 0.75, 0.5])
    assert verdict.objections == (Objection.FENCE,)


def test_along_the_fence_and_past_a_neighbour_nothing_is_held_back() -> None:
    around = replace(near([0.5, 0.0, 0.0]), position=np.array([101.0, 0.0]))
    verdict = Stream().second([0.0, 1.0], around=around)
    np.testing.assert_array_equal(sent(verdict).velocity, [0.0, 1.0])
    assert verdict.objections == ()


def test_beyond_the_corner_of_a_fence_only_the_way_back_is_left() -> None:
    square = ((-10.0, -10.0), (-10.0, 10.0), (10.0, 10.0), (10.0, -10.0))
    parameters = DRAG_FREE.model_copy(update={"fence_corners_m": square, "fence_radius_m": None})
    corner = replace(HOME, position=np.array([11.0, 11.0]))
    verdict = Stream(parameters).second([1.0, 0.0], around=corner)
    np.testing.assert_allclose(sent(verdict).velocity, [0.5, -0.5])  # what of it is not along (1, 1)
    assert verdict.objections == (Objection.FENCE,)


def test_the_height_is_brought_into_the_band() -> None:
    heights = GateParameters(min_height_m=2.0, max_height_m=20.0)
    for asked_m, sent_m in ((1.0, 2.0), (2.0, 2.0), (20.0, 20.0), (25.0, 20.0)):
        verdict = Stream(heights).step([0.0, 0.0], around=replace(HOME, height_m=math.nan), height_m=asked_m)
        assert sent(verdict).height_m == sent_m
        assert verdict.objections == (() if asked_m == sent_m else (Objection.HEIGHT,))


def test_below_home_and_alone_a_drone_stays_as_low_as_it_is() -> None:
    valley = GateParameters(min_height_m=-50.0)
    assert sent(Stream(valley).step(STILL, around=replace(HOME, height_m=-20.0), height_m=-20.0)).height_m == -20.0


def test_the_height_changes_at_the_limit_and_not_at_all_while_the_drone_stands_still() -> None:
    stream = Stream(GateParameters(max_climb_m_s=1.0))
    climbed = [sent(stream.step(STILL, height_m=9.0)).height_m for _ in range(41)]
    np.testing.assert_allclose(climbed, 5.0 + 0.05 * np.arange(41))  # from the drone's own height, at 1 m/s
    assert sent(stream.step(STILL, Action.HOVER, height_m=9.0)).height_m == pytest.approx(7.0)
    assert sent(stream.step(STILL, Action.ASK_HOLD, height_m=5.0)).height_m == pytest.approx(7.0)
    assert sent(stream.step(STILL, Action.FLY_DEGRADED, height_m=5.0)).height_m == pytest.approx(6.95)
    assert sent(stream.step(STILL, height_m=6.94)).height_m == pytest.approx(6.94)
    assert sent(stream.step(STILL, Action.OFFER, height_m=9.0)).height_m == 9.0


def test_an_old_command_climbs_ever_slower() -> None:
    gate = Gate(GateParameters(max_climb_m_s=1.0, command_fresh_s=0.9, command_timeout_s=1.5))
    heights = []
    for step in range(31):
        now_s = 0.05 * step
        verdict = judge(gate, now_s, Permission(Action.FLY, now_s), wanted(STILL, time_s=0.0, height_m=9.0), HOME)
        heights.append(sent(verdict).height_m)
    climbs = np.diff(heights) / 0.05
    np.testing.assert_allclose(climbs[:18], 1.0)
    np.testing.assert_allclose(climbs[23], 0.5)  # at 1.2 s, half way from 0.9 s to 1.5 s
    np.testing.assert_allclose(climbs[-1], 0.0, atol=1e-12)


def test_after_silence_the_height_starts_again_from_the_drones_own() -> None:
    stream = Stream()
    stream.step(STILL, height_m=5.0)
    stream.now_s += 0.31
    assert sent(stream.step(STILL, around=replace(HOME, height_m=7.0), height_m=5.0)).height_m == 7.0


# Separation.


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
    around = near([2.2, 0.0, -above_m])
    stream = Stream(DRAG_FREE.model_copy(update={"max_climb_m_s": 20.0}))
    stream.step(STILL, around=around)
    verdict = stream.step(STILL, around=around, height_m=asked_m)
    assert sent(verdict).height_m == pytest.approx(sent_m)
    assert verdict.objections == (() if sent_m == asked_m else (Objection.SEPARATION,))
    beside = near([2.25, 0.0, -above_m])
    assert sent(stream.step(STILL, around=beside, height_m=asked_m)).height_m == pytest.approx(asked_m)


def test_between_one_above_and_one_below_the_height_stays_and_does_not_creep() -> None:
    stream = Stream()
    for step in range(200):
        noise_m = 0.25 * math.sin(step)
        both = replace(near([0.5, 0.0, -2.0], [0.0, 0.5, 2.0]), height_m=5.0 + noise_m)
        assert sent(stream.step(STILL, around=both, height_m=5.0)).height_m == pytest.approx(5.0, abs=1e-9)
    drifted = replace(both, height_m=4.0)  # it is below what was asked for by more than noise: no climb back
    assert sent(stream.step(STILL, around=drifted, height_m=5.0)).height_m == pytest.approx(4.3)
    stream = Stream()
    stream.step(STILL, around=replace(both, height_m=5.0), height_m=5.0)
    assert sent(stream.step(STILL, around=replace(both, height_m=6.0), height_m=5.0)).height_m == pytest.approx(5.7)


def test_without_a_height_of_its_own_a_drone_counts_as_where_it_was_asked_to_be() -> None:
    unknown = replace(near([1.0, 0.0, -1.5]), height_m=math.nan)
    stream = Stream()
    assert sent(stream.step(STILL, around=unknown, height_m=5.0)).height_m == 5.0
    assert sent(stream.step(STILL, around=unknown, height_m=6.0)).height_m == 5.0
    assert sent(stream.step(STILL, around=unknown, height_m=4.9)).height_m == pytest.approx(4.925)


def test_a_neighbour_1_5_m_below_counts_as_one_at_the_drones_height() -> None:
    for down_m in (1.5, 2.9, -1.5, -2.9):
        verdict = Stream().second([1.0, 0.5], around=near([0.9, 0.0, down_m]))
        np.testing.assert_allclose(sent(verdict).velocity, [0.0, 0.5])
        assert verdict.objections == (Objection.SEPARATION,)


def test_no_velocity_towards_a_neighbour_that_is_too_near() -> None:
    verdict = Stream().second([1.0, 0.5], around=near([0.9, 0.0, 0.0]))
    np.testing.assert_allclose(sent(verdict).velocity, [0.0, 0.5])
    assert verdict.objections == (Objection.SEPARATION,)


def test_away_from_it_and_below_or_far_from_another_the_drone_may_fly() -> None:
    for around in (near([-0.9, 0.0, 0.0]), near([4.0, 0.0, 0.0]), near([0.7, 0.0, 3.0]), near([0.7, 0.0, -3.0])):
        verdict = Stream().second([1.0, 0.5], around=around)
        np.testing.assert_allclose(sent(verdict).velocity, [1.0, 0.5])
        assert verdict.objections == ()


def test_degraded_it_keeps_farther_away() -> None:
    parameters = DRAG_FREE.model_copy(update={"degraded_separation_m": 1.5, "neighbour_reaction_s": 0.5})
    for action, velocity in ((Action.FLY, [0.2, 0.5]), (Action.FLY_DEGRADED, [0.0, 0.5])):
        np.testing.assert_allclose(
            sent(Stream(parameters).second([0.2, 0.5], action, near([1.4, 0.0, 0.0]))).velocity, velocity
        )
    moving = replace(near([1.4, 0.0, 0.0]), velocity=np.array([1.0, 0.0]))
    np.testing.assert_allclose(sent(Stream(parameters).step([0.0, 0.0], Action.HOVER, moving)).velocity, STILL)


def test_a_neighbour_straight_above_is_in_no_direction() -> None:
    verdict = Stream().second([1.0, 0.5], around=near([0.0, 0.0, -0.5]))
    np.testing.assert_allclose(sent(verdict).velocity, [1.0, 0.5])
    assert verdict.objections == ()


@pytest.mark.parametrize("range_m", [0.0, 1e-163, 1e-9, 0.099])
def test_a_neighbour_nearer_than_its_direction_can_be_measured_is_in_no_direction(range_m: float) -> None:
    verdict = Stream().second([1.0, 0.5], around=near([range_m, 0.0, 0.0]))
    np.testing.assert_allclose(sent(verdict).velocity, [1.0, 0.5])
    assert verdict.objections == ()


def test_towards_a_neighbour_it_flies_no_faster_than_it_can_brake() -> None:
    parameters = DRAG_FREE.model_copy(update={"braking_m_s2": 2.0, "neighbour_reaction_s": 0.5})
    # 3 m to the minimum distance of 1 m. Both at 1.65 m/s: half a second takes 1.65 m, braking 2 * 1.65^2 / (2 * 2) m.
    verdict = Stream(parameters).second([3.5, 0.5], around=near([4.0, 0.0, 0.0]))
    np.testing.assert_allclose(sent(verdict).velocity, [1.6458, 0.5], atol=1e-4)
    assert verdict.objections == (Objection.SEPARATION,)
    # It comes at 2 m/s: 1 m for its half second and 1 m to brake; 1 m is left for 0.5 s and the braking from 1.24 m/s.
    coming = replace(near([4.0, 0.0, 0.0]), neighbour_velocities=np.array([[-2.0, 0.3]]))
    verdict = Stream(parameters).second([3.5, 0.0], around=coming)
    np.testing.assert_allclose(sent(verdict).velocity, [1.2361, 0.0], atol=1e-4)
    # One that comes at 4 m/s needs all of the 3 m and more.
    racing = replace(near([4.0, 0.0, 0.0]), neighbour_velocities=np.array([[-4.0, 0.0]]))
    np.testing.assert_allclose(sent(Stream(parameters).second([3.5, 0.0], around=racing)).velocity, STILL, atol=1e-9)
    # Behind one that flies ahead at the same 2 m/s just outside the minimum distance nothing is held back.
    ahead = replace(near([1.01, 0.0, 0.0]), neighbour_velocities=np.array([[2.0, 0.0]]))
    np.testing.assert_allclose(sent(Stream(parameters).second([2.0, 0.0], around=ahead)).velocity, [2.0, 0.0])


def test_towards_one_that_comes_faster_than_both_can_brake_it_does_not_fly() -> None:
    coming = replace(near([2.5, 0.0, 0.0]), neighbour_velocities=np.array([[-3.0, 0.0]]))
    np.testing.assert_allclose(sent(Stream().second([1.0, 0.0], around=coming)).velocity, STILL, atol=1e-12)


def test_an_uncertain_neighbour_counts_as_nearer_and_faster() -> None:
    """4 m with a margin of 0.5 m is 3.5 m, and 1 m/s towards the drone with one of 1 m/s are 2 m/s."""
    exact = replace(near([3.5, 0.0, 0.0]), neighbour_velocities=np.array([[-2.0, 0.0]]))
    uncertain = replace(
        near([4.0, 0.0, 0.0]),
        neighbour_velocities=np.array([[-1.0, 0.0]]),
        neighbour_margins=np.array([[0.5, 1.0]]),
    )
    parameters = DRAG_FREE.model_copy(update={"neighbour_reaction_s": 0.2})
    expected = sent(Stream(parameters).second([3.5, 0.0], around=exact)).velocity
    assert 0.3 < expected[0] < 3.0
    np.testing.assert_allclose(sent(Stream(parameters).second([3.5, 0.0], around=uncertain)).velocity, expected)
    # A flock mate that flies ahead is followed by its likeliest velocity: doubt about it holds nobody back.
    ahead = replace(
        near([4.0, 0.0, 0.0]), neighbour_velocities=np.array([[1.0, 0.0]]), neighbour_margins=np.array([[0.2, 0.4]])
    )
    np.testing.assert_allclose(sent(Stream(parameters).second([1.0, 0.0], around=ahead)).velocity, [1.0, 0.0])


@pytest.mark.fault("neighbour-too-near")
@pytest.mark.parametrize(("lag_s", "period_s", "least_m"), [(0.0, 0.05, 1.0), (0.35, 0.5, 0.999)])
def test_two_that_fly_at_each_other_at_3_m_s_stop_before_the_minimum_distance(
    lag_s: float, period_s: float, least_m: float
) -> None:
    """Point masses, 20 m apart, that brake at 5 m/s^2; then ones that lag too, and see each other twice a second."""
    gates = [Stream(GateParameters()), Stream(GateParameters())]
    places, velocities = np.array([[0.0, 0.0], [20.0, 0.0]]), np.array([[3.0, 0.0], [-3.0, 0.0]])
    seen, seen_velocities, nearest_m = places, velocities, 20.0
    for step in range(400):
        if step % round(period_s / 0.05) == 0:
            seen, seen_velocities, seen_s = places, velocities, step * 0.05
        setpoints = np.zeros((2, 2))
        for me, other in ((0, 1), (1, 0)):
            offset = seen[other] + seen_velocities[other] * (step * 0.05 - seen_s) - places[me]
            around = Surroundings(
                position=places[me],
                velocity=velocities[me],
                yaw_rad=0.0,
                neighbours=np.array([[*offset, 0.0]]),
                neighbour_velocities=seen_velocities[[other]],
                height_m=5.0,
            )
            setpoints[me] = sent(gates[me].step([3.0 - 6.0 * me, 0.0], around=around)).velocity
        for _ in range(5):
            change = (setpoints - velocities) * (1.0 if lag_s == 0.0 else 0.01 / lag_s)
            velocities = velocities + np.clip(change, -0.05, 0.05)  # 5 m/s^2 for 0.01 s
            places = places + 0.01 * velocities
            nearest_m = min(nearest_m, float(np.linalg.norm(places[1] - places[0])))
    assert least_m <= nearest_m < 1.3


def test_between_two_neighbours_only_the_way_between_or_standstill_is_left() -> None:
    ahead_and_right = near([0.5, 0.0, 0.0], [0.0, 0.5, 0.0])
    np.testing.assert_allclose(sent(Stream().second([1.0, 0.5], around=ahead_and_right)).velocity, STILL, atol=1e-12)
    np.testing.assert_allclose(sent(Stream().second([1.0, -0.5], around=ahead_and_right)).velocity, [0.0, -0.5])


def test_separation_and_fence_hold_together() -> None:
    around = replace(near([0.0, 0.5, 0.0]), position=np.array([101.0, 0.0]))
    verdict = Stream().second([1.0, 1.0], around=around)
    np.testing.assert_allclose(sent(verdict).velocity, STILL, atol=1e-12)
    assert verdict.objections == (Objection.FENCE, Objection.SEPARATION)


def test_separation_wins_over_the_acceleration_limit() -> None:
    stream = Stream(GateParameters(max_acceleration_m_s2=2.0))
    for _ in range(20):
        stream.step([1.0, 0.0])
    np.testing.assert_allclose(sent(stream.step([1.0, 0.0], around=near([0.9, 0.0, 0.0]))).velocity, STILL, atol=1e-12)


# Whatever the numbers are.

PARAMETERS = GateParameters(
    max_speed_m_s=3.0,
    max_acceleration_m_s2=4.0,
    degraded_speed_m_s=1.0,
    min_separation_m=1.0,
    degraded_separation_m=1.5,
    fence_radius_m=12.0,
    fence_corners_m=((-8.0, -10.0), (-8.0, 10.0), (10.0, 10.0), (10.0, 2.0), (2.0, 2.0), (2.0, -10.0)),
    min_height_m=2.0,
    max_height_m=20.0,
)
OUTLINE = np.concatenate(
    [
        np.linspace(a, b, 400, endpoint=False)
        for a, b in zip(PARAMETERS.fence_corners_m, (*PARAMETERS.fence_corners_m[1:], (-8.0, -10.0)), strict=True)
    ]
)


def _number(rng: np.random.Generator, scale: float, odd: float) -> float:
    """Mostly an ordinary number; with the probability `odd` one that nobody reckons with."""
    if rng.random() < odd:
        return float(rng.choice([math.nan, math.inf, -math.inf, 1e300, -1e9, 0.0]))
    return float(rng.normal(0.0, scale))


def _vector(rng: np.random.Generator, size: int, scale: float, odd: float) -> FloatArray:
    return np.array([_number(rng, scale, odd) for _ in range(size)])


@pytest.mark.parametrize("odd", [0.0, 0.02, 0.2])
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.filterwarnings("ignore:overflow encountered")
def test_whatever_is_asked_for_what_is_sent_is_safe(seed: int, odd: float) -> None:
    """The measured velocity is random too: the drone seems to be blown about."""
    rng = np.random.default_rng(seed)
    gate, last, now_s = Gate(PARAMETERS), None, 0.0
    total = {"sent": 0, "moving": 0, "near": 0, "outside": 0, "climbing": 0, "stacked": 0}
    for _ in range(1000):
        now_s += float(rng.choice([0.0, 0.05, 0.05, 0.05, 0.2]))
        action = Action(rng.choice([Action.FLY, Action.FLY, Action.FLY_DEGRADED, *Action]))
        permission = Permission(action, now_s - abs(_number(rng, 0.1, odd)))
        want = wanted(
            _vector(rng, 2, 1.5, odd),
            time_s=now_s - abs(_number(rng, 0.6, odd)),
            height_m=10.0 + _number(rng, 8.0, odd),
            yaw_rad=_number(rng, 2.0, odd),
        )
        number = int(rng.integers(0, 4))
        around = Surroundings(
            position=_vector(rng, 2, 6.0, odd),
            velocity=_vector(rng, 2, 2.0, odd),
            yaw_rad=_number(rng, 2.0, odd),
            neighbours=np.array([_vector(rng, 3, 1.0, odd) for _ in range(number)]).reshape(-1, 3),
            neighbour_velocities=np.array([_vector(rng, 2, 1.0, odd) for _ in range(number)]).reshape(-1, 2),
            height_m=10.0 + _number(rng, 3.0, odd),
        )
        verdict = judge(gate, now_s, permission, want, around)
        setpoint = verdict.setpoint
        fresh = now_s - permission.time_s <= 0.3 and action is not Action.SILENCE
        if action in (Action.FLY, Action.FLY_DEGRADED):
            fresh &= now_s - want.wanted_s <= 1.5
        if setpoint is None:
            assert odd or not fresh
        else:
            assert fresh
            total["sent"] += 1
            total["moving"] += bool(np.linalg.norm(setpoint.velocity) > 0.1)
            assert np.isfinite([*setpoint.velocity, setpoint.height_m, setpoint.yaw_rad, setpoint.time_s]).all()
            assert np.linalg.norm(setpoint.velocity) <= 3.0 + 1e-9
            assert 2.0 <= setpoint.height_m <= 20.0
            if last is not None and not {Objection.FENCE, Objection.SEPARATION} & {*verdict.objections}:
                change = np.linalg.norm(setpoint.velocity - last.velocity)
                assert change <= 4.0 * (now_s - last.time_s) + 1e-9
            separation_m = 1.0 if action is Action.FLY else 1.5
            total["near"] += _assert_not_towards_a_near_one(setpoint.velocity, around, separation_m)
            total["outside"] += _assert_not_outward(setpoint.velocity, around)
            if last is not None and action not in (Action.OFFER, Action.SILENCE):
                climb = setpoint.height_m - last.height_m
                spent_m = 1.5 * (now_s - last.time_s) if action in (Action.FLY, Action.FLY_DEGRADED) else 0.0
                total["climbing"] += abs(climb) > 0.01
                assert Objection.SEPARATION in verdict.objections or abs(climb) <= spent_m + 1e-9
            total["stacked"] += action is not Action.OFFER and _assert_not_into_a_stack(setpoint, around)
        last = setpoint
    assert total["moving"] > 20
    assert total["near"] > 20
    assert total["outside"] > 20
    assert total["climbing"] > 20
    assert total["stacked"] > 20


def _assert_not_towards_a_near_one(velocity: FloatArray, around: Surroundings, separation_m: float) -> bool:
    near_ones = [
        n
        for n in around.neighbours
        if np.isfinite(n).all() and math.hypot(*n) < separation_m and math.hypot(*n[:2]) >= 0.1
    ]
    for neighbour in near_ones:
        soon = neighbour[:2] - 1e-6 * velocity
        assert math.hypot(*soon) >= math.hypot(*neighbour[:2]) - 1e-14
    return bool(near_ones)


def _assert_not_into_a_stack(setpoint: Setpoint, around: Surroundings) -> bool:
    """No climb of more than noise towards a neighbour less than 3 m above, and no sinking towards one below."""
    if not math.isfinite(around.height_m):
        return False
    stacked = False
    for north, east, down in around.neighbours:
        if np.isfinite([north, east, down]).all() and math.hypot(north, east) < 2.25 and 0 < abs(down) < 3.0:
            stacked = True
            over = (setpoint.height_m - around.height_m) * (-1 if down > 0 else 1)
            assert over <= 0.3 + 1e-9 or setpoint.height_m in (PARAMETERS.min_height_m, PARAMETERS.max_height_m)
    return stacked


def _assert_not_outward(velocity: FloatArray, around: Surroundings) -> bool:
    here = around.position
    if not (np.abs(here) < 1e6).all():
        return False
    soon = here + 1e-4 * velocity
    outside = False
    if math.hypot(*here) > 12.0:
        outside = True
        assert math.hypot(*soon) <= math.hypot(*here) + 1e-8  # along a circle it grows with the square of the way
    if here[0] < -8.0 or abs(here[1]) > 10.0 or here[0] > 10.0 or (here[0] > 2.0 and here[1] < 2.0):
        outside = True
        foot = OUTLINE[np.argmin(np.linalg.norm(OUTLINE - here, axis=1))]  # the fence's nearest point, to 5 cm
        assert velocity @ (here - foot) <= 0.03 * np.linalg.norm(velocity) + 1e-9
    return outside


def test_what_is_left_is_the_nearest_to_what_was_asked_for() -> None:
    """Against all velocities of a fine grid: none leads towards what is within 1 m, nor faster than can be braked."""
    rng = np.random.default_rng(5)
    angles = np.linspace(0.0, math.tau, 360, endpoint=False)
    speeds = np.linspace(0.0, 1.5, 151)
    grid = np.concatenate([speed * np.column_stack([np.cos(angles), np.sin(angles)]) for speed in speeds])
    parameters = DRAG_FREE.model_copy(update={"braking_m_s2": 1.5, "neighbour_reaction_s": 0.5})
    for _ in range(40):
        bearings, ranges = rng.uniform(0.0, math.tau, (n := int(rng.integers(1, 4)))), rng.uniform(0.1, 1.4, n)
        towards = np.column_stack([np.cos(bearings), np.sin(bearings)])
        velocity = rng.normal(0.0, 0.6, 2)
        around = near(*np.column_stack([ranges[:, None] * towards, np.zeros(n)]))
        left = sent(Stream(parameters).second(velocity, around=around)).velocity
        along = grid @ towards.T
        needed_m = 2 * (0.5 * along + along**2 / 3.0)
        allowed = grid[((along <= 1e-9) | (needed_m <= ranges - 1.0)).all(axis=1)]
        nearest = np.linalg.norm(allowed - velocity, axis=1).min()
        assert np.linalg.norm(left - velocity) <= nearest + 1e-6
        assert np.linalg.norm(left - velocity) >= nearest - 0.02  # the grid's step

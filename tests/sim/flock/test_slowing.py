"""What a gate slowed its drone down for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from flockd.core.messages import Wanted
from flockd.flight.safety import (
    Action,
    Event,
    Gate,
    GateParameters,
    Objection,
    Permission,
    Request,
    Surroundings,
    Verdict,
)
from flockd.sim.flock.slowing import Cause, SlowedTime, causes_of, is_slowed, which_are_drones

GATE = GateParameters(fence_radius_m=None, max_acceleration_m_s2=50.0)
NEAR, FAR, ASIDE = [1.2, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 5.0, 0.0]
ALONE = Surroundings(np.zeros(2), np.zeros(2), 0.0, np.empty((0, 3)), np.empty((0, 2)), 5.0)


def _around(*places: list[float], margin_m: float = 0.0) -> Surroundings:
    n = len(places)
    offsets, margins = np.reshape(np.array(places, dtype=float), (n, 3)), np.full((n, 2), margin_m)
    return replace(ALONE, neighbours=offsets, neighbour_velocities=np.zeros((n, 2)), neighbour_margins=margins)


def _causes(
    seen: Surroundings,
    truth: Surroundings,
    *,
    action: Action = Action.FLY,
    asked: ArrayLike = (1.0, 0.0),
    degraded_by: tuple[Event, ...] = (),
) -> frozenset[Cause]:
    """Of a second tick that asks for 1 m/s north."""
    gate, parameters = Gate(GATE), GATE
    for now_s in (0.0, 0.1):
        wanted = Wanted(np.array(asked, dtype=float), np.zeros(2), 0.0)
        request = Request(Permission(action, now_s), wanted, now_s, 5.0, seen)
        verdict = gate.step(now_s, request)
    is_drone = which_are_drones(seen.neighbours, truth.neighbours)
    slowed = is_slowed(request, verdict)
    return causes_of(parameters, request, verdict, truth, is_drone, degraded_by) if slowed else frozenset()


def test_a_drone_that_is_there_is_a_neighbour() -> None:
    assert _causes(_around(NEAR), _around(NEAR)) == {Cause.NEIGHBOUR}


def test_a_track_without_a_drone_is_a_false_detection() -> None:
    assert _causes(_around(NEAR), _around(FAR)) == {Cause.FALSE_DETECTION}
    assert _causes(_around(NEAR), _around()) == {Cause.FALSE_DETECTION}


def test_one_that_would_not_limit_where_it_truly_is_does_so_by_its_uncertainty() -> None:
    assert _causes(_around([3.0, 0.0, 0.0], margin_m=3.0), _around([3.0, 0.0, 0.0])) == {Cause.UNCERTAINTY}


def test_two_may_limit_at_once() -> None:
    ahead = [1.2, 0.6, 0.0]
    both = _around(NEAR, ahead)
    assert _causes(both, _around(NEAR)) == {Cause.NEIGHBOUR}, "nearer than 1 m to a drone a track is its"
    seen, truth = _around(NEAR, [1.5, -1.2, 0.0]), _around(NEAR)
    assert _causes(seen, truth, asked=(1.0, -0.5)) == {Cause.NEIGHBOUR, Cause.FALSE_DETECTION}


@pytest.mark.parametrize(
    ("event", "cause"),
    [
        (Event.VELOCITY_OFF, Cause.WIND),
        (Event.NO_ROOM_TO_HOLD, Cause.WIND),
        (Event.CAMERA_LOST, Cause.CAMERA),
        (Event.FENCE_LEFT, Cause.FENCE),
        (Event.HEIGHTS_LEFT, Cause.OTHER),
    ],
)
def test_a_degraded_drone_is_slowed_by_what_degraded_it(event: Event, cause: Cause) -> None:
    degraded = _causes(ALONE, _around(), action=Action.FLY_DEGRADED, asked=(1.5, 0.0), degraded_by=(event,))
    assert degraded == {cause}
    assert _causes(ALONE, _around(), asked=(1.0, 0.0), degraded_by=(event,)) == frozenset(), "long over"


def test_an_obstacle_and_anything_else() -> None:
    assert _causes(replace(ALONE, obstacles=np.array([[0.7, 0.0]])), _around()) == {Cause.OBSTACLE}
    assert _causes(ALONE, _around(), asked=(9.0, 0.0)) == {Cause.OTHER}, "refused as too fast"


def test_the_fence() -> None:
    verdict = Verdict(None, (Objection.FENCE,))
    request = Request(Permission(Action.FLY, 0.0), Wanted(np.array([1.0, 0.0]), np.zeros(2), 0.0), 0.0, 5.0, ALONE)
    assert causes_of(GATE, request, verdict, ALONE, np.empty(0, dtype=bool)) == {Cause.FENCE}


def test_what_is_flown_as_asked_is_not_slowed() -> None:
    assert _causes(_around(ASIDE, FAR), _around(ASIDE, FAR)) == frozenset()


def test_times_are_summed_by_cause() -> None:
    time = SlowedTime()
    assert (time.share, time.by_cause) == (None, {})
    time.add(6.0, frozenset())
    time.add(3.0, frozenset({Cause.NEIGHBOUR}))
    time.add(1.0, frozenset({Cause.NEIGHBOUR, Cause.WIND}))
    assert time.share == pytest.approx(0.4)
    assert time.by_cause == pytest.approx({"neighbour": 0.4, "wind": 0.1})

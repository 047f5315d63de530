"""Cameras that rest at short steps, where nothing is near or tracked."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from flockd.core.messages import FloatArray, PilotOutput
from flockd.flight.perception.observation import CameraObservation, Observation
from flockd.flight.pilot.turns import Turns
from tests.flight.geometry.synthetic_world import four_camera_rig
from tests.flight.pilot.flyer import Flyer, scenario_with
from tests.make import changed, vehicle

RIG = four_camera_rig()
NOWHERE = np.empty((0, 3))
LONGEST_REST_S, AROUND_M = 0.5, 1.0
STEPS = np.arange(200.0)


def looked(
    times_s: Iterable[float],
    places: FloatArray = NOWHERE,
    rest_s: float = LONGEST_REST_S,
    names: Collection[str] = RIG.cameras,
    refused_each: int = 1000,
) -> list[set[str]]:
    """Which cameras with these names are looked at in each step; `refused_each`: some steps' images are not used."""
    turns, last, found = Turns(RIG, rest_s, AROUND_M), None, [set[str]()]
    flow, image = np.zeros((1, 1, 2), np.float32), np.zeros((1, 1), np.uint8)
    for time_s in times_s:
        before = last.cameras if last is not None and last.time_s < time_s else ()
        found.append(set(names) - turns.resting(time_s, names, last, lambda: places))
        seen = {name: CameraObservation(image, None, image, flow if name in before else None) for name in found[-1]}
        last = Observation(time_s, vehicle(height_m=4.0), seen if len(found) % refused_each else {}, (), None)
    return found[1:]


@pytest.mark.parametrize(("step_s", "rest_s"), [(0.5, 0.5), (0.6, 0.5), (0.3, 0.5), (0.1, 0.1), (0.1, 0.0)])
def test_no_camera_rests_where_two_steps_are_longer_than_a_rest(step_s: float, rest_s: float) -> None:
    assert all(names == set(RIG.cameras) for names in looked(step_s * STEPS, rest_s=rest_s))


@pytest.mark.parametrize("step_s", [0.05, 0.1, 0.2, 0.25])
def test_each_side_is_looked_at_in_time_and_half_of_them_in_pairs(step_s: float) -> None:
    steps = looked(step_s * STEPS)
    for name in RIG.cameras:
        at = [k for k, names in enumerate(steps) if name in names]
        assert max(np.diff([*at, len(steps)])) * step_s <= LONGEST_REST_S + 1e-9
        assert all({k - 1, k + 1} & {*at, len(steps)} for k in at), "each look gives flow, or the next one does"
    assert all(2 * len(one & other) >= len(RIG.cameras) for one, other in pairwise(steps))
    assert np.quantile([len(names) for names in steps], 0.8) == 3, "no two that began to rest together end together"
    assert sum(map(len, steps)) < (2.6 if step_s <= 0.1 else 3.1) * len(steps)


@pytest.mark.parametrize("place", [(6.0, 0.0, 0.0), (0.0, -3.0, 0.5), (-4.0, -4.5, 0.0)])
def test_a_side_with_something_in_view_never_rests(place: tuple[float, ...]) -> None:
    seeing = RIG.looking_at(np.array([place]), AROUND_M)
    assert seeing
    assert all(seeing <= names for names in looked(0.1 * STEPS, np.array([place])))


def test_after_a_gap_and_when_time_runs_backwards_all_are_looked_at() -> None:
    """And once more, if they had no image before."""
    steps = looked([3.0, 3.1, 3.2, 9.0, 8.9, 9.0, 9.1])
    assert [names == set(RIG.cameras) for names in steps] == [True, True, False, True, True, True, False]
    assert all(looked(0.1 * STEPS, names=["left"])), "the only camera with an image never rests"
    assert all(len(names) >= 2 for names in looked(0.05 * STEPS, refused_each=7)), "half, though none gave an image"


def looks_of(flyer: Flyer, steps: int) -> Iterator[tuple[PilotOutput, set[str]]]:
    """What the pilot puts out, and the cameras that it looked at, in steps of 0.1 s northward at 1 m/s."""
    cameras = set[str]()

    def scene(frame: Any, *rest: Any) -> Any:
        cameras.add(frame.camera)
        return flyer.truth.sound("scene")(frame, *rest)

    flyer.truth.instead["scene"] = scene
    for _ in range(steps):
        cameras.clear()
        yield flyer.step(), set(cameras)
        count = len(flyer.scenario.vehicles)
        flyer.vehicles.step(np.tile([1.0, 0.0], (count, 1)), np.zeros(count), 0.1)
        flyer.time_s += 0.1
        flyer.steps += 1


def test_the_camera_that_looks_where_the_drone_flies_never_rests() -> None:
    steps = list(looks_of(Flyer(scenario_with((0.0, 0.0, -4.0), (-30.0, 0.0, -4.0))), 12))
    assert all("front" in cameras for _, cameras in steps[2:]), "the first two show the velocity"
    assert max(len(cameras) for _, cameras in steps[2:]) == 3


@pytest.mark.parametrize("obstacles", [False, True])
def test_a_pilot_at_short_steps_looks_at_fewer_images_and_knows_the_same(obstacles: bool) -> None:
    """A drone ahead is seen in each step, and so is the own motion; one that appears behind within a rest."""
    scenario, looks = scenario_with((0.0, 0.0, -4.0), (5.0, 0.0, -4.0), (-30.0, 0.0, -4.0)), 0
    flyer = Flyer(scenario.model_copy(update={"drone": changed(scenario.drone, obstacles__enabled=obstacles)}))
    for step, (output, cameras) in enumerate(looks_of(flyer, 20)):
        assert output.ego_motion is not None or step == 0
        assert not [reason.text for reason in output.reasons if step]
        assert all(one.unseen_s == 0.0 for one in output.neighbours), "what is known is seen in each step"
        assert len(output.neighbours) == 1 or step >= 10
        if step == 9:
            flyer.vehicles.position[2] = flyer.vehicles.position[0] + [-4.0, 0.0, 0.0]
        looks += len(cameras)
    assert sum(one.confirmed for one in output.neighbours) == 2
    assert looks == 20 * len(RIG.cameras) if obstacles else looks < 0.75 * 20 * len(RIG.cameras)

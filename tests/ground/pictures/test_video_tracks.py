"""Drones of a video keep their numbers: made-up boxes of known motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from flockd.ground.pictures.single_frame import DetectedDrone
from flockd.ground.pictures.video_tracks import VideoTracker

SIZE = (640, 480)
RATE_HZ = 30.0
Place = tuple[float, float]


def boxed(middle: Place, side: float = 30.0) -> DetectedDrone:
    """A drone as the detector gives it."""
    (u, v), half = middle, side / 2
    return DetectedDrone((u - half, v - half, u + half, v + half), 0.97, 5.0, 0.5, 0.4, 0.04, True, 1)


def followed(
    frames: int, show: Callable[[int], Sequence[DetectedDrone]], rate_hz: float = RATE_HZ
) -> list[tuple[DetectedDrone, ...]]:
    """What the tracker says of each frame."""
    tracker = VideoTracker()
    return [tracker.update(k / rate_hz, SIZE, show(k)) for k in range(frames)]


def middle(one: DetectedDrone) -> Place:
    left, top, right, bottom = one.box
    return (left + right) / 2, (top + bottom) / 2


@pytest.mark.parametrize("every", [1, 5])
def test_two_drones_that_pass_each_other_keep_their_numbers(every: int) -> None:
    """One from the left and one from the right, at half a picture per second, 20 pixels apart where they meet."""

    def places(k: int) -> tuple[Place, Place]:
        way = 320 * k * every / RATE_HZ
        return (20 + way, 240), (620 - way, 260)

    found = followed(54 // every, lambda k: [boxed(place) for place in places(k)[:: 1 if k % 2 else -1]], 30 / every)
    first = 20 // every
    numbers = [one.track for one in sorted(found[first], key=middle)]
    assert sorted(numbers, key=str) == [1, 2]
    for k in range(first, 54 // every):
        by_number = {one.track: middle(one) for one in found[k]}
        assert [by_number[number] for number in numbers] == [pytest.approx(place) for place in places(k)]


def test_a_drone_that_is_missed_in_half_of_the_frames_is_shown_in_all() -> None:
    """Frames are missed in runs of up to ten; where it should be meanwhile errs by less than its size."""
    rng = np.random.default_rng(4)
    hidden = {int(k) + j for k in rng.choice(np.arange(60, 300, 20), 12, replace=False) for j in range(10)}

    def place(k: int) -> Place:
        return 320 + 200 * np.cos(k / 40), 240 + 150 * np.sin(k / 40)

    def seen(k: int) -> list[DetectedDrone]:
        u, v = np.array(place(k)) + rng.normal(0, 1.5, 2)
        return [] if k in hidden else [boxed((u, v))]

    found = followed(300, seen)
    shown = found[20:]
    assert all([one.track for one in frame] == [1] for frame in shown)
    assert {k for k, frame in enumerate(shown, start=20) if not frame[0].label} == hidden
    assert max(np.hypot(*np.subtract(middle(one), place(k))) for k, (one,) in enumerate(shown, start=20)) < 30


def test_what_shows_in_single_frames_only_is_no_drone() -> None:
    """A false detection in each third frame, each time elsewhere."""
    rng = np.random.default_rng(7)
    found = followed(300, lambda k: [boxed((rng.uniform(0, 640), rng.uniform(0, 480)))] if k % 3 == 0 else [])
    assert not any(found)


def test_a_drone_that_leaves_the_picture_is_shown_no_longer_and_keeps_its_number_if_it_returns() -> None:
    """It leaves by the right border after 2 s, and is back 0.4 s later where it left."""
    found = followed(
        110,
        lambda k: [boxed((640 - abs(630 - 10 * k), 200))] if k < 62 else [boxed((630 - 5 * (k - 74), 200))] * (k > 73),
    )
    assert [one.track for one in found[60]] == [1]
    assert found[70] == ()
    assert [one.track for one in found[100]] == [1]

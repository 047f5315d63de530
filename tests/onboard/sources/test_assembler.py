"""Frames of several cameras become sets, on a clock that only the test moves."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from flockd.core.config.source import SourceParameters
from flockd.onboard.sources.assembler import Assembler, RawFrameSet
from flockd.onboard.sources.frames import RawFrame
from flockd.onboard.sources.image_formats import RgbFormat

FOUR = ("front", "right", "back", "left")
PERIOD_S = 1.0 / 30.0


class Stage:
    """An assembler, its clock, and cameras that send what the test says: each picture new unless told otherwise."""

    def __init__(self, *cameras: str, **parameters: float) -> None:
        self.now_s = 1000.0
        asked = {"set_tolerance_s": 0.02, "set_wait_s": 0.1, "frozen_after": 5, **parameters}
        self.assembler = Assembler(cameras, SourceParameters.model_validate({"kind": "shared_memory", **asked}))
        self._sequence = dict.fromkeys(cameras, 0)

    def send(self, camera: str, time_s: float, *, data: bytes | None = None, sequence: int | None = None) -> str | None:
        number = self._sequence[camera] if sequence is None else sequence
        self._sequence[camera] = number + 1
        content = f"{camera} {time_s}".encode() if data is None else data
        frame = RawFrame(camera, content, RgbFormat((32, 32)).pixels, time_s, number)
        return self.assembler.offer(frame, self.now_s)

    def take(self) -> RawFrameSet | None:
        return self.assembler.take(self.now_s)

    def stamps(self) -> dict[str, float] | None:
        """Time stamps of the next set, by camera."""
        taken = self.take()
        return None if taken is None else {name: frame.time_s for name, frame in taken.frames.items()}

    def count(self, camera: str, what: str) -> int:
        return {str(key): value for key, value in self.assembler.counts(camera).items()}.get(what, 0)


def test_cameras_that_fire_together_become_a_set_when_the_last_has_come() -> None:
    stage = Stage(*FOUR)
    for camera in FOUR[:3]:
        stage.send(camera, 5.0)
    assert stage.take() is None
    stage.send("left", 5.0)
    taken = stage.take()
    assert taken is not None
    assert taken.time_s == 5.0
    assert taken.frames.keys() == set(FOUR)
    assert stage.take() is None


def test_cameras_that_run_freely_are_put_together_within_half_a_period() -> None:
    """Four at 30 Hz with phases 0, 8, 16 and 25 ms: every picture has a partner in every camera within 17 ms."""
    stage = Stage(*FOUR)
    phases = dict(zip(FOUR, (0.0, 0.008, 0.016, 0.025), strict=True))
    arrivals = sorted((n * PERIOD_S + phase, camera) for camera, phase in phases.items() for n in range(30))
    times = []
    for time_s, camera in arrivals:
        stage.now_s = 1000.0 + time_s
        stage.send(camera, time_s)
        taken = stage.take()
        if taken is not None:
            assert taken.frames.keys() == set(FOUR)
            assert all(abs(frame.time_s - taken.time_s) <= 0.02 for frame in taken.frames.values())
            times.append(taken.time_s)
    assert 28 <= len(times) <= 30, "a set each period"
    assert all(later > earlier for earlier, later in itertools.pairwise(times))


def test_a_constantly_later_camera_still_gets_its_place() -> None:
    """The back camera's images come 70 ms after the front's; sets are as old as that, and complete."""
    stage = Stage("front", "back")
    events = sorted(
        [(n * PERIOD_S, "front", n * PERIOD_S) for n in range(30)]
        + [(n * PERIOD_S + 0.07, "back", n * PERIOD_S) for n in range(30)]
    )
    complete = 0
    for arrival_s, camera, time_s in events:
        stage.now_s = 1000.0 + arrival_s
        stage.send(camera, time_s)
        stamps = stage.stamps()
        complete += stamps is not None and len(stamps) == 2
    assert complete == 30
    assert stage.count("back", "late") == stage.count("back", "missing") == 0


def test_sets_go_on_without_a_camera_that_has_gone_and_with_it_when_it_is_back() -> None:
    stage = Stage("front", "back")
    for n in range(3):
        stage.now_s = 1000.0 + n * PERIOD_S
        stage.send("front", n * PERIOD_S)
        stage.send("back", n * PERIOD_S)
        assert stage.stamps() == {"front": n * PERIOD_S, "back": n * PERIOD_S}

    first_alone_s = math.inf
    for n in range(3, 30):  # the back camera is pulled out
        stage.now_s = 1000.0 + n * PERIOD_S
        stage.send("front", n * PERIOD_S)
        stamps = stage.stamps()
        if stamps is not None:
            assert stamps.keys() == {"front"}
            first_alone_s = min(first_alone_s, n * PERIOD_S)
    assert first_alone_s == pytest.approx(3 * PERIOD_S + 0.1, abs=1.1 * PERIOD_S), "0.1 s after it was due"
    assert stage.count("back", "missing") >= 22, "and then at once"
    assert stage.assembler.age_s("back", stage.now_s) == pytest.approx(27 * PERIOD_S)

    stage.now_s += PERIOD_S
    stage.send("front", 30 * PERIOD_S)
    stage.send("back", 30 * PERIOD_S, sequence=0)
    assert stage.stamps() == {"front": 30 * PERIOD_S, "back": 30 * PERIOD_S}
    assert stage.count("back", "lost") == 0, "it counts from zero again"


def test_one_camera_out_of_step_does_not_part_the_others() -> None:
    """The left camera is 15 ms off where 5 ms are allowed: what goes on after the wait is the larger part."""
    stage = Stage("front", "right", "left", set_tolerance_s=0.005)
    sets = []
    for n in range(30):
        for camera, phase in (("front", 0.0), ("right", 0.0), ("left", 0.015)):
            stage.now_s = 1000.0 + n * PERIOD_S + phase
            stage.send(camera, n * PERIOD_S + phase)
        sets.append(stage.stamps())
    assert {frozenset(stamps) for stamps in sets if stamps} == {frozenset({"front", "right"})}


def test_what_comes_after_its_set_has_gone_is_late() -> None:
    stage = Stage("front", "back")
    stage.send("front", 0.0)
    stage.now_s += 0.15
    assert stage.stamps() == {"front": 0.0}
    stage.send("front", 0.2)
    stage.now_s += 0.15
    assert stage.stamps() == {"front": 0.2}
    assert stage.send("back", 0.1) == "late"
    assert stage.count("back", "late") == 1
    assert stage.assembler.age_s("back", stage.now_s) == math.inf, "what is of no use is no sign of life"


def test_of_two_frames_within_the_tolerance_the_nearer_is_taken() -> None:
    stage = Stage("front", "back")
    stage.send("back", 0.986)
    stage.send("back", 1.0)
    stage.send("front", 1.003)
    assert stage.stamps() == {"front": 1.003, "back": 1.0}


def test_a_frame_just_older_than_the_last_set_begins_none_but_may_join_the_next() -> None:
    stage = Stage("front", "back")
    stage.send("front", 1.0)
    stage.now_s += 0.11
    assert stage.stamps() == {"front": 1.0}
    assert stage.send("back", 0.99) is None
    stage.now_s += 0.11
    assert stage.take() is None
    stage.send("front", 1.005)
    assert stage.stamps() == {"front": 1.005, "back": 0.99}


@pytest.mark.parametrize("time_s", [5.0, 4.9, -3.0, math.nan, math.inf])
def test_a_stamp_that_stands_still_or_goes_back_or_is_no_number_is_dropped(time_s: float) -> None:
    stage = Stage("front")
    assert stage.send("front", 5.0) is None
    assert stage.send("front", time_s) == "time_stamp"
    assert stage.stamps() == {"front": 5.0}
    assert stage.send("front", 5.1) is None
    assert stage.stamps() == {"front": 5.1}
    assert stage.count("front", "time_stamp") == 1


def test_an_image_that_repeats_itself_is_frozen_until_it_changes() -> None:
    stage = Stage("front", "back", frozen_after=3)
    verdicts = []
    for n in range(7):
        stage.now_s = 1000.0 + n * PERIOD_S
        stage.send("back", n * PERIOD_S)
        verdicts.append(stage.send("front", n * PERIOD_S, data=b"the same"))
    assert verdicts == [None, None, None, "frozen", "frozen", "frozen", "frozen"]
    assert stage.count("front", "frozen") == 4
    assert stage.assembler.age_s("front", stage.now_s) == pytest.approx(4 * PERIOD_S)
    assert stage.assembler.age_s("back", stage.now_s) == 0.0
    assert stage.send("front", 7 * PERIOD_S, data=b"another") is None


def test_a_sequence_number_that_stands_still_is_frozen_whatever_the_image() -> None:
    stage = Stage("front", frozen_after=2)
    assert [stage.send("front", 0.1 * n, sequence=7) for n in range(4)] == [None, None, "frozen", "frozen"]


def test_a_simulators_images_may_repeat_for_ever() -> None:
    stage = Stage("front", frozen_after=0)
    assert {stage.send("front", 0.1 * n, data=b"the same") for n in range(50)} == {None}


def test_gaps_in_the_sequence_are_counted() -> None:
    stage = Stage("front")
    for sequence in (0, 1, 5, 6, 8):
        stage.send("front", 0.1 * sequence, sequence=sequence)
    assert stage.count("front", "lost") == 4


def test_no_frame_is_in_two_sets_and_set_times_increase_whatever_comes() -> None:
    """Jitter, losses and delays drawn at random: what must hold of every set does."""
    rng = random.Random(7)
    stage = Stage(*FOUR)
    events = []
    for index, camera in enumerate(FOUR):
        for n in range(300):
            if rng.random() < 0.1:
                continue
            time_s = n * PERIOD_S + 0.007 * index + rng.uniform(-0.003, 0.003)
            events.append((time_s + rng.expovariate(1 / 0.02), camera, time_s, n))
    seen: set[tuple[str, float]] = set()
    last_s = -math.inf
    sets = 0
    for arrival_s, camera, time_s, sequence in sorted(events):
        stage.now_s = 1000.0 + arrival_s
        stage.send(camera, time_s, sequence=sequence)
        taken = stage.take()
        if taken is None:
            continue
        sets += 1
        assert taken.time_s > last_s
        last_s = taken.time_s
        for name, frame in taken.frames.items():
            assert abs(frame.time_s - taken.time_s) <= 0.02
            assert (name, frame.time_s) not in seen
            seen.add((name, frame.time_s))
    assert sets > 100
    for camera in FOUR:
        counts = stage.assembler.counts(camera)
        ended = sum(counts.get(what, 0) for what in ("used", "superseded", "late", "time_stamp"))
        assert counts["received"] - ended in range(17), "every frame is accounted for, but for those still held"
        assert counts["used"] + counts.get("missing", 0) == sets

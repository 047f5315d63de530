"""The catalogue of faults: each has a row, a name, and the stories that inject it. `python -m tools.faults` runs them.

A story is a test; most start a whole drone (`tests.faults.process`). It notes how long the reaction took with
`reacted`, and asserts what the row promises beside it: the event that is reported, and how it goes on afterwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

RecordProperty = Callable[[str, object], None]
"""pytest's fixture `record_property`."""
REACTION = "reaction_s of "
"""A property of a test's report begins with this, and goes on with the fault's name."""


@dataclass(frozen=True)
class Fault:
    """One row."""

    row: int
    name: str
    """For `--only`."""
    fault: str
    reaction: str
    stories: tuple[str, ...]
    """Ids of tests."""
    within_s: float | None = None
    """The longest reaction; None where the reaction is not a matter of time."""


def reacted(record: RecordProperty, name: str, seconds: float) -> None:
    """Notes how long the reaction to a fault took; an assertion fails when that was too long."""
    limit_s = fault_named(name).within_s
    record(f"{REACTION}{name}", round(seconds, 3))
    assert limit_s is not None, f"{name} is not a matter of time"
    assert 0.0 <= seconds <= limit_s, f"the reaction to {name} took {seconds:.2f} s"


def fault_named(name: str) -> Fault:
    """The fault of this name. Raises KeyError."""
    for fault in CATALOGUE:
        if fault.name == name:
            return fault
    raise KeyError(name)


_HERE = "tests/faults"
CATALOGUE = (
    Fault(
        1,
        "camera-unplugged",
        "no camera delivers images any more",
        "hover for a second at most, then Hold; no return by itself",
        (
            f"{_HERE}/test_cameras.py::test_no_camera_delivers_any_more",
            "tests/sources/test_v4l2.py::test_an_unplugged_camera_is_reported_at_once_and_comes_back_when_plugged_in",
        ),
        within_s=3.0,
    ),
    Fault(
        2,
        "frozen-frames",
        "the same image again and again",
        "as for a camera that is unplugged",
        (
            f"{_HERE}/test_cameras.py::test_all_cameras_freeze",
            "tests/sources/test_v4l2.py::test_a_frozen_camera_counts_as_silent",
        ),
        within_s=3.0,
    ),
)

"""Key frames hold what the pilot worked with, and nothing where there was nothing to work with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from flockd.flight.pilot import FlockPilot, StepTrace
from flockd.onboard.recording.reader import Recording
from flockd.review.flight_log.key_frames import capture, key_frame_steps

RECORDING = Path(__file__).parents[2] / "review" / "replay" / "normal.mcap"


def test_key_frames_are_spread_from_the_first_step_with_flow() -> None:
    assert sorted(key_frame_steps(221)) == [1, 44, 88, 132, 176, 220]
    assert sorted(key_frame_steps(20)) == [1, 10, 19], "three are enough of ten seconds"
    assert sorted(key_frame_steps(3)) == [1, 2]


@pytest.mark.parametrize("height_m", [3.0, -0.5], ids=["in the air", "in the ground"])
def test_a_step_without_a_usable_image_has_no_key_frame(height_m: float) -> None:
    """Cameras that are not above the ground have no metric scale, so the pilot uses none of their images."""
    recording = Recording(RECORDING)
    step = next(iter(recording.steps()))
    pilot = FlockPilot(recording.config)
    trace = StepTrace()
    output = pilot.step(step.frames, replace(step.vehicle, height_m=height_m), trace)
    captured = capture(trace, output, drone=0)
    assert [set(frame.cameras) for frame in captured] == ([set(step.frames.frames)] if height_m > 0 else [])

"""A camera that sends noise invents no drones and does not steer: the shipped networks on rendered images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flockd.config.scenario import CameraFaultConfig
from flockd.inference.manifest_file import models_folder
from flockd.messages import FrameSet, PilotOutput, VehicleState
from flockd.perception import OnnxNetworks
from flockd.pilot import FlockPilot
from flockd.recording.reader import Recording
from flockd.sim.camera_faults import noisy_image

CAMERA = "left"
NOISE_BEGINS, NOISE_ENDS, STEPS = 2, 6, 8
Step = tuple[FrameSet, VehicleState]


@pytest.fixture(scope="module")
def recording() -> Recording:
    return Recording(Path(__file__).parents[1] / "replay" / "normal.mcap")


def noisy(frames: FrameSet, rng: np.random.Generator) -> FrameSet:
    fault = CameraFaultConfig(drone=1, camera=CAMERA, kind="uniform")
    frame = frames.frames[CAMERA]
    spoilt = replace(frame, image=noisy_image(frame.image, fault, rng))
    return replace(frames, frames={**frames.frames, CAMERA: spoilt})


def without(frames: FrameSet) -> FrameSet:
    return replace(frames, frames={name: frame for name, frame in frames.frames.items() if name != CAMERA})


def confirmed(output: PilotOutput) -> int:
    return sum(neighbour.confirmed for neighbour in output.neighbours)


def test_a_noisy_camera_is_flown_without_from_its_first_noisy_image_until_it_is_good_again(
    recording: Recording,
) -> None:
    """Without a check, from the fourth noisy image on: 8 and 9 neighbours instead of 1, 0.9 m/s another command."""
    config = recording.config
    networks = OnnxNetworks(config.perception, models_folder(config.perception))
    given: Sequence[Step] = [(step.frames, step.vehicle) for step in recording.steps()][:STEPS]
    rng = np.random.default_rng(1)
    failing, lacking = FlockPilot(config, networks), FlockPilot(config, networks)
    outputs: list[tuple[PilotOutput, PilotOutput]] = []
    for number, (frames, vehicle) in enumerate(given):
        bad = NOISE_BEGINS <= number < NOISE_ENDS
        shown = noisy(frames, rng) if bad else frames
        # Its first clean image is not trusted yet, so that it is absent once more.
        left = without(frames) if NOISE_BEGINS <= number <= NOISE_ENDS else frames
        outputs.append((failing.step(shown, vehicle), lacking.step(left, vehicle)))

    for number, (found, reference) in enumerate(outputs):
        refused = NOISE_BEGINS <= number <= NOISE_ENDS
        assert found.noisy_cameras == ((CAMERA,) if refused else None)
        assert (f"camera {CAMERA}: its image is noise" in found.reasons) == refused
        assert confirmed(found) == confirmed(reference)
        assert np.linalg.norm(found.command.velocity - reference.command.velocity) < 0.1
    assert confirmed(outputs[-1][0]) == 1, "the neighbour that the others see"
    assert not any(CAMERA in reason for reason in outputs[-1][0].reasons), "it is flown on with"

"""A camera that sends noise invents no drones and does not steer: the shipped networks on rendered images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from flockd.core.messages import FrameSet, PilotOutput, UInt8Array, VehicleState
from flockd.flight.inference.manifest_file import models_folder
from flockd.flight.perception import OnnxNetworks
from flockd.flight.pilot import FlockPilot
from flockd.onboard.recording.reader import Recording
from flockd.sim.cameras.camera_simulator import noisy_image
from flockd.sim.scenario import CameraFaultConfig

pytestmark = pytest.mark.fault("noisy-camera")

CAMERA = "left"
NOISE_BEGINS, NOISE_ENDS, STEPS = 2, 6, 8
Step = tuple[FrameSet, VehicleState]


@pytest.fixture(scope="module")
def recording() -> Recording:
    return Recording(Path(__file__).parents[2] / "review" / "replay" / "normal.mcap")


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
        assert found.noisy_cameras == ((CAMERA,) if refused else ())
        assert (f"camera {CAMERA}: its image is noise" in found.counts) == refused
        assert confirmed(found) == confirmed(reference)
        assert np.linalg.norm(found.command.velocity - reference.command.velocity) < 0.1
    assert confirmed(outputs[-1][0]) == 1, "the neighbour that the others see"
    assert not any(CAMERA in reason.text for reason in outputs[-1][0].reasons), "it is flown on with"


def blocks(image: UInt8Array, number: int, rng: np.random.Generator) -> UInt8Array:
    """Squares of 16 pixels, each of one colour, as of a damaged video: at fine scales there is nothing of noise."""
    rows, columns = image.shape[0] // 16, image.shape[1] // 16
    colours = rng.integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(colours, image.shape[1::-1], interpolation=cv2.INTER_NEAREST), np.uint8)


def slow_soft_noise(image: UInt8Array, number: int, rng: np.random.Generator) -> UInt8Array:
    """Filtered noise of 10 grey levels more with each image, up to 60: never is there much more than in the last."""
    soft = cv2.GaussianBlur(rng.standard_normal(image.shape), (0, 0), 1.5)
    added = image + min(10.0 * (number + 1), 60.0) / soft.std() * soft
    return np.asarray(np.clip(added, 0, 255), np.uint8)


def test_a_camera_whose_images_do_not_follow_from_each_other_does_not_steer(recording: Recording) -> None:
    """Without a check, from the third image on: blocks gave 0.94 m/s another command, and so did slow noise, 0.92."""
    config = recording.config
    networks = OnnxNetworks(config.perception, models_folder(config.perception))
    given: Sequence[Step] = [(step.frames, step.vehicle) for step in recording.steps()][:STEPS]
    reference = FlockPilot(config, networks)
    wanted = [
        reference.step(without(frames) if number >= NOISE_BEGINS else frames, vehicle)
        for number, (frames, vehicle) in enumerate(given)
    ]
    for spoil in (blocks, slow_soft_noise):
        rng, pilot = np.random.default_rng(1), FlockPilot(config, networks)
        for number, (frames, vehicle) in enumerate(given):
            if number >= NOISE_BEGINS:
                frame = frames.frames[CAMERA]
                spoilt = replace(frame, image=spoil(frame.image, number - NOISE_BEGINS, rng))
                frames = replace(frames, frames={**frames.frames, CAMERA: spoilt})  # noqa: PLW2901
            found = pilot.step(frames, vehicle)
            assert confirmed(found) == confirmed(wanted[number])
            assert np.linalg.norm(found.command.velocity - wanted[number].command.velocity) < 0.1
        assert found.noisy_cameras == (CAMERA,)
        assert f"camera {CAMERA}: its image does not follow from the one before" in found.counts

"""A camera that sends noise invents no drones and does not steer: the shipped networks on rendered images."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from flockd.core.messages import PilotOutput, UInt8Array
from flockd.flight.inference.manifest_file import models_folder
from flockd.flight.perception import OnnxNetworks
from flockd.flight.pilot import FlockPilot
from flockd.onboard.recording.reader import Recording

pytestmark = pytest.mark.fault("noisy-camera")

CAMERA = "left"
STEPS, BEGINS = 8, 2


@pytest.fixture(scope="module")
def recording() -> Recording:
    return Recording(Path(__file__).parents[2] / "review" / "replay" / "normal.mcap")


@pytest.fixture(scope="module")
def networks(recording: Recording) -> OnnxNetworks:
    return OnnxNetworks(recording.config.perception, models_folder(recording.config.perception))


def confirmed(output: PilotOutput) -> int:
    return sum(neighbour.confirmed for neighbour in output.neighbours)


Spoil = Callable[[UInt8Array, int, np.random.Generator], UInt8Array]


def noise(image: UInt8Array, number: int, rng: np.random.Generator) -> UInt8Array:
    """In every pixel, until its camera is good again after four images."""
    return rng.integers(0, 256, image.shape, dtype=np.uint8) if number < 4 else image


def blocks(image: UInt8Array, number: int, rng: np.random.Generator) -> UInt8Array:
    """Squares of 16 pixels, each of one colour, as of a damaged video: at fine scales there is nothing of noise."""
    rows, columns = image.shape[0] // 16, image.shape[1] // 16
    colours = rng.integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(colours, image.shape[1::-1], interpolation=cv2.INTER_NEAREST), np.uint8)


@pytest.mark.parametrize(
    ("spoil", "refused", "why"),
    [
        (noise, range(2, 7), "its image is noise"),  # its first clean image is not trusted yet
        (blocks, range(2, 8), "its image does not follow from the one before"),
    ],
)
def test_a_camera_with_bad_images_is_flown_without_until_it_is_good_again(
    recording: Recording, networks: OnnxNetworks, spoil: Spoil, refused: range, why: str
) -> None:
    """Without a check: 8 and 9 neighbours instead of 1, and 0.9 m/s another command."""
    config, rng = recording.config, np.random.default_rng(1)
    failing, lacking = FlockPilot(config, networks), FlockPilot(config, networks)
    for number, step in enumerate(itertools.islice(recording.steps(), STEPS)):
        frames, left = step.frames, step.frames
        if number >= BEGINS:
            frame = frames.frames[CAMERA]
            spoilt = replace(frame, image=spoil(frame.image, number - BEGINS, rng))
            frames = replace(frames, frames={**frames.frames, CAMERA: spoilt})
        if number in refused:
            left = replace(left, frames={name: one for name, one in left.frames.items() if name != CAMERA})
        found, reference = failing.step(frames, step.vehicle), lacking.step(left, step.vehicle)
        assert found.noisy_cameras == ((CAMERA,) if number in refused else ())
        assert (f"camera {CAMERA}: {why}" in found.counts) == bool(found.noisy_cameras)
        assert confirmed(found) == confirmed(reference)
        assert np.linalg.norm(found.command.velocity - reference.command.velocity) < 0.1
    assert confirmed(found) == 1, "the neighbour that the others see"

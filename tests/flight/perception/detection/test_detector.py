"""The detection pipeline on true maps: proposals, masks, and what one stage does not know of the other's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import UNCLASSED, BoolArray, Detection, UInt8Array
from flockd.flight.perception import Crop, RangeEstimate
from flockd.flight.perception.detection.detector import DetectionTrace, Detector
from flockd.flight.perception.detection.masks import without_borders
from tests.flight.pilot.flyer import Flyer, SpoilableTruth, scenario_with

PARAMETERS = DetectionParameters()
COLOUR_WEIGHT = PARAMETERS.colour_weight


class Scene:
    """One camera's true maps of a moment, which a test may spoil before the detector gets them."""

    def __init__(self, flyer: Flyer) -> None:
        self._flyer = flyer
        self.frames, self.vehicle = flyer.take_frames()
        cameras = flyer.cameras.rig.cameras
        maps = {n: flyer.truth.scene(frame, cameras[n], None) for n, frame in self.frames.frames.items()}
        (self.camera,) = [name for name, scene in maps.items() if scene.instances]
        self.maps = maps[self.camera]

    def detect(self, image: UInt8Array | None = None) -> tuple[tuple[Detection, ...], UInt8Array]:
        """By the true second stage."""
        images = {self.camera: self.frames.frames[self.camera].image if image is None else image}
        detector = Detector(self._flyer.cameras.rig, self._flyer.truth, PARAMETERS)
        scenes = {self.camera: self.maps}
        found = detector.detect(images, scenes, {}, self.vehicle, (), DetectionTrace())
        return found.detections, found.masks[self.camera]


@pytest.mark.parametrize(("probability", "certain", "uncertain"), [(0.05, 0, 0), (0.35, 255, 255), (0.9, 1, 255)])
def test_what_is_no_drone_belongs_to_the_background_again(probability: float, certain: int, uncertain: int) -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.0, -4.0)))
    scene = Scene(flyer)
    estimates = flyer.truth.sound("ranges")
    flyer.truth.instead["ranges"] = lambda crops: tuple(
        replace(e, drone_probability=probability) for e in estimates(crops)
    )
    drone = scene.maps.labels > 0
    upper = drone & (np.cumsum(drone.any(axis=1)) < np.ptp(np.flatnonzero(drone.any(axis=1))) / 2)[:, None]
    scene.maps = replace(scene.maps, uncertain=upper)
    _, labels = scene.detect()
    assert set(labels[drone & ~upper]) == {certain}
    assert set(labels[upper]) == {uncertain}


def with_discs(truth: SpoilableTruth, height: float) -> Callable[[Sequence[Crop]], tuple[RangeEstimate, ...]]:
    """The second stage, with masks: a disc somewhat wider than the drone, so high inside and so deep outside."""
    estimates = truth.sound("ranges")

    def ranges(crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        v, u = np.mgrid[0:96, 0:96] + 0.5
        masked = []
        for crop, estimate in zip(crops, estimates(crops), strict=True):
            reach_px = 0.6 * estimate.size_m * crop.camera.focal_px / np.exp(estimate.log_range)
            inside = np.hypot(u - estimate.centre[0], v - estimate.centre[1]) < reach_px
            masked.append(replace(estimate, mask=np.where(inside, height, -height).astype(np.float32)))
        return tuple(masked)

    return ranges


def test_two_drones_that_the_first_stage_takes_for_one_are_two() -> None:
    """The far one's pixels count for the near one's, until the second stage says which of them are the near one's."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.3, -4.0), (6.0, -0.6, -4.0), sharp=True))
    flyer.truth.instead["ranges"] = with_discs(flyer.truth, 9.0)
    scene = Scene(flyer)
    (near, far), true = scene.maps.instances, scene.maps.labels
    pixels = true > 0
    both = replace(near, box=np.concatenate([np.minimum(near.box, far.box)[:2], np.maximum(near.box, far.box)[2:]]))
    labels = np.where(pixels, np.uint8(near.label), np.uint8(0))
    logit = np.where(pixels, np.float32(3.0), np.float32(-3.0))[1::2, 1::2]
    scene.maps = replace(scene.maps, labels=labels, instances=(both,), uncertain=~pixels, logit=logit)
    detections, seen = scene.detect()
    assert sorted(d.range_m for d in detections) == pytest.approx([3.01, 6.03], abs=0.1)
    assert {*seen[true == near.label]} & {*seen[true == far.label]} <= {0, 255}


def test_masks_are_drawn_as_colours_say() -> None:
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.3, -4.0)))
    flyer.truth.instead["ranges"] = with_discs(flyer.truth, 3.0)
    scene = Scene(flyer)
    scene.maps = replace(scene.maps, logit=np.zeros(scene.maps.labels[1::2, 1::2].shape, np.float32))

    def drawn(image: UInt8Array) -> BoolArray:
        detections, labels = scene.detect(image)
        return np.asarray(labels == detections[0].label)

    meadow = np.full_like(scene.frames.frames[scene.camera].image, 90)
    disc = drawn(meadow)
    columns = np.nonzero(disc)[1]
    sliver = disc & (np.arange(disc.shape[1]) > np.quantile(columns, 0.9))
    found = drawn(np.where((disc & ~sliver)[:, :, None], np.array([200, 30, 30], np.uint8), meadow))
    assert found[disc & ~sliver].mean() > 0.95
    assert found[sliver].mean() < 0.05, "what has the meadow's colour is the meadow"


def test_background_beside_a_drone_is_not_used() -> None:
    labels = np.zeros((9, 9), np.uint8)
    labels[4, 4] = 1
    bordered = without_borders(labels, 2)
    assert bordered[4, 4] == 1
    assert (bordered == UNCLASSED).sum() == 24  # of 5 x 5, all but the drone
    assert (without_borders(np.zeros((9, 9), np.uint8), 2) == 0).all()

"""The detection pipeline on true maps: proposals, masks, and what one stage does not know of the other's."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import UNCLASSED, Detection, UInt8Array
from flockd.flight.perception.detection.detector import DetectionTrace, Detector, without_borders
from tests.flight.pilot.flyer import Flyer, scenario_with

PARAMETERS = DetectionParameters()


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
        found = detector.detect(images, scenes, self.vehicle, (), DetectionTrace(), None)
        return found.detections, found.masks[self.camera]


@pytest.mark.parametrize(("probability", "count", "label"), [(0.05, 0, 0), (0.35, 0, 255), (0.6, 1, 255), (0.9, 1, 1)])
def test_what_is_no_drone_belongs_to_the_background_again(probability: float, count: int, label: int) -> None:
    """Detected is what is likelier a drone than not; pixels are only a sure drone's."""
    flyer = Flyer(scenario_with((0.0, 0.0, -4.0), (3.0, 0.0, -4.0)))
    scene = Scene(flyer)
    estimates = flyer.truth.sound("ranges")
    flyer.truth.instead["ranges"] = lambda crops: estimates(crops)._replace(
        drone_probability=np.full(len(crops), probability)
    )
    found, labels = scene.detect()
    assert [one.drone_probability for one in found] == count * [probability]
    assert set(labels[scene.maps.labels > 0]) == {label}


def test_background_beside_a_drone_is_not_used() -> None:
    labels = np.zeros((9, 9), np.uint8)
    labels[4, 4] = 1
    bordered = without_borders(labels, 2)
    assert bordered[4, 4] == 1
    assert (bordered == UNCLASSED).sum() == 24  # of 5 x 5, all but the drone
    assert (without_borders(np.zeros((9, 9), np.uint8), 2) == 0).all()

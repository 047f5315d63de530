"""The detection pipeline of a frame set: propose, crop, refine, suppress, mask."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import UNCLASSED, Detection, LearnedSize, Reason, UInt8Array, VehicleState
from flockd.flight.geometry import Rig
from flockd.flight.perception.detection.instances import Instance
from flockd.flight.perception.detection.nms import suppress
from flockd.flight.perception.detection.proposals import Proposal, propose_instances, propose_predictions
from flockd.flight.perception.detection.refinement import Candidate, Cascade
from flockd.flight.perception.interface import Networks, SceneMaps
from flockd.flight.tracking import Prediction


@dataclass(frozen=True, eq=False)
class Detected:
    """The drones in view, with their masks."""

    detections: tuple[Detection, ...]
    masks: Mapping[str, UInt8Array]
    """(h, w) labels of the detections, by camera."""
    reasons: tuple[Reason, ...] = ()
    """Why proposals were dropped."""


@dataclass
class DetectionTrace:
    """Intermediate results of the detector, for reports and measurements: filled if a caller passes one in."""

    proposals: list[Proposal] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)


class Detector:
    """Finds drones in the images of a rig."""

    def __init__(self, rig: Rig, networks: Networks, parameters: DetectionParameters) -> None:
        self._rig, self._networks, self._parameters = rig, networks, parameters

    def detect(
        self,
        images: Mapping[str, UInt8Array],
        scenes: Mapping[str, SceneMaps],
        vehicle: VehicleState,
        predictions: Sequence[Prediction],
        trace: DetectionTrace,
        known_size: LearnedSize | None,
    ) -> Detected:
        """The drones in view, and their masks.

        Args:
            images: (h, w, 3) by camera.
            scenes: the first stage's maps of each.
            vehicle: for the attitude.
            predictions: of tracks; the second stage searches there too.
            trace: filled.
            known_size: of every drone; None: the network estimates each one's.
        """
        if not images:
            return Detected((), {})
        rig = Rig({name: self._rig.cameras[name] for name in images})
        stage = self._networks.second_stage
        cascade, sure = Cascade(self._networks, self._parameters, known_size, rig, images), stage.drone_probability
        proposals = propose_instances(rig, scenes, stage.rules, self._parameters)
        predicted, unpredicted = propose_predictions(rig, vehicle, predictions, stage.rules)
        refined = cascade.refine(proposals, predicted)
        trace.proposals += [*proposals, *predicted]
        trace.candidates += refined.candidates
        detections, label_of = suppress(refined.candidates, self._parameters, sure)
        # Only the pixels of sure detections are a drone's; those of the others are of no class.
        of_sure = {one.label for one in detections if one.drone_probability >= sure}
        none = {proposal.instance for proposal in refined.rejected if proposal.instance}
        masks = {}
        for name, scene in scenes.items():
            labels = {instance: label for instance, label in label_of[name].items() if label in of_sure}
            masks[name] = first_stage_labels(scene, labels, none)
        return Detected(detections, masks, (*unpredicted, *cascade.reasons))


def first_stage_labels(scene: SceneMaps, label_of: Mapping[int, int], rejected: Container[Instance]) -> UInt8Array:
    """(h, w) the first stage's instances, with the labels of their detections.

    Instances that the second stage rejects become background, undecided ones `UNCLASSED`.
    """
    table = np.full(256, UNCLASSED, np.uint8)
    table[0] = 0
    for instance in scene.instances:
        otherwise = 0 if instance in rejected else UNCLASSED
        table[instance.label] = label_of.get(instance.label, otherwise)
    return np.asarray(cv2.LUT(scene.labels, table), np.uint8)


def without_borders(labels: UInt8Array, border_px: int) -> UInt8Array:
    """Background within ``border_px`` of a drone becomes `UNCLASSED`: masks and depth maps are least certain there."""
    drone = cv2.threshold(labels, 0, UNCLASSED, cv2.THRESH_BINARY)[1]
    wide = cv2.dilate(drone, np.ones((2 * border_px + 1, 2 * border_px + 1), np.uint8))
    return np.asarray(cv2.bitwise_or(labels, cv2.bitwise_xor(wide, drone)), np.uint8)  # `UNCLASSED` has all bits set

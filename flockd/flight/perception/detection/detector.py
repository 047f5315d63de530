"""The detection pipeline of a frame set: propose, crop, refine, suppress, mask."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import Detection, Reason, UInt8Array, VehicleState
from flockd.flight.geometry import RangeMap, Rig
from flockd.flight.perception.detection.from_depth import candidates_from_depth
from flockd.flight.perception.detection.instances import Instance
from flockd.flight.perception.detection.masks import first_stage_labels
from flockd.flight.perception.detection.nms import Suppressed, suppress
from flockd.flight.perception.detection.proposals import Proposal, propose_instances, propose_predictions
from flockd.flight.perception.detection.refinement import Candidate, Cascade
from flockd.flight.perception.interface import Networks
from flockd.flight.perception.maps import KnownSize, SceneMaps
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
        depths: Mapping[str, RangeMap],
        vehicle: VehicleState,
        predictions: Sequence[Prediction],
        trace: DetectionTrace,
        known_size: KnownSize | None = None,
    ) -> Detected:
        """The drones in view, and their masks.

        Args:
            images: (h, w, 3) by camera.
            scenes: the first stage's maps of each.
            depths: (h, w) metres along the ray, of the cameras that have them.
            vehicle: for the attitude.
            predictions: of tracks; the second stage searches there too.
            trace: filled.
            known_size: of every drone; None: the network estimates each one's.
        """
        if not images:
            return Detected((), {})
        rig = Rig({name: self._rig.cameras[name] for name in images})
        stage = self._networks.second_stage
        if stage is None:
            trace.candidates += candidates_from_depth(rig, scenes, depths, self._parameters)
            return _masked(suppress(trace.candidates, self._parameters), scenes)
        rules, cascade = stage.rules, Cascade(self._networks, stage, self._parameters, known_size, rig, images)
        proposals = propose_instances(rig, scenes, rules, self._parameters)
        first = cascade.refine(proposals)
        sure = stage.thresholds.drone
        found = [(c.bearing, c.log_range) for c in first.candidates if c.drone_probability >= sure]
        predicted, unpredicted = propose_predictions(rig, vehicle, predictions, found, rules)
        second = cascade.refine(predicted)
        candidates = [*first.candidates, *second.candidates]
        none = {proposal.instance for proposal in first.rejected if proposal.instance}
        trace.proposals += [*proposals, *predicted]
        trace.candidates += candidates
        reasons = (*unpredicted, *cascade.reasons)
        return _masked(suppress(candidates, self._parameters, sure), scenes, none, reasons, sure)


def _masked(
    found: Suppressed,
    scenes: Mapping[str, SceneMaps],
    rejected: Container[Instance] = (),
    reasons: tuple[Reason, ...] = (),
    sure: float = 0.0,
) -> Detected:
    """With the masks of the detections that are at least so probable; pixels of the others are of no class."""
    of_sure = {one.label for one in found.detections if one.drone_probability >= sure}
    masks = {}
    for name, scene in scenes.items():
        labels = {instance: label for instance, label in found.labels_of(name).items() if label in of_sure}
        masks[name] = first_stage_labels(scene, labels, rejected)
    return Detected(found.detections, masks, reasons)

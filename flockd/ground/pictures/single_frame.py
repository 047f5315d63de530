"""Detection in one picture by the pipeline that flies; nothing is known of attitude, height or tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from flockd.core.config.perception import DIS, PerceptionConfig
from flockd.core.messages import Detection, FloatArray, Frame, FrameSet, UInt8Array, VehicleState
from flockd.flight.geometry import R_FRD_RDF, Camera, PinholeCamera, Rig, RigCamera, RigidTransform, WideAngleCamera
from flockd.flight.perception import Networks, Perception, load_networks
from flockd.flight.perception.detection.detector import DetectionTrace
from flockd.flight.perception.detection.proposals import angles_between
from flockd.flight.perception.detection.refinement import Candidate

MAX_SIDE_PX = 1280
"""Larger pictures are resized to this before the networks: they were trained on cameras of 640 pixels."""
WIDEST_PINHOLE_DEG = 100.0
_MAX_INSTANCE = 2.0
"""An instance's longer side over the drone's apparent size, for it to be of this drone alone: masks of soft pictures
lack thin arms and propellers, which the first stage has, but it may take several drones for one."""
KNOWN_LOG_SIZE_SIGMA = 0.03
"""Below this sigma a network knows the airframe: so it reports for 65 % of the detections of rendered airframes that it
learnt, for 3 % of those of 14 that it did not, and for 0.2 % of those of an F450, a Hubsan H107D+ and a Crazyflie."""
UNKNOWN_LOG_SIZE_SIGMA = 0.85
"""Sigma of the others. With it 89 and 95 % of the errors of five airframes that no network learnt lie within one and
two standard deviations, 78 and 98 % of nine more, and of each real one 97 % or more within two."""
_ANY_RANGE_M = 1e4
_UNKNOWN_HEIGHT_M = 5.0
"""Not used: the networks give the scale. A vehicle state has to hold some height."""

Box = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels of the picture."""


@dataclass(frozen=True)
class DetectedDrone:
    """One detection in one picture."""

    box: Box
    """The detector's; where it has none, around the mask and the first stage's instances of it."""
    probability: float
    range_m: float
    range_sigma_m: float
    size_m: float
    size_sigma_m: float
    """Standard deviation: of the known size, else the range's share."""
    kind_known: bool
    """Whether the networks know an airframe such as this, or its size was said. Otherwise the size, and the range with
    it, errs by a factor: the standard deviations are those of the logarithm times the value."""
    label: int
    """Its value in the mask; 0: this frame of the video does not show it, and the box is where it should be."""
    track: int | None = None
    """The number of the drone in a video; None in a picture."""


@dataclass(frozen=True, eq=False)
class PictureResult:
    """What the pipeline found in one picture."""

    detections: tuple[DetectedDrone, ...]
    proposals: int
    """Regions that went to the second stage."""
    mask: UInt8Array
    """(h, w) labels of the detections' pixels, at the size that the networks saw; 0 is background."""

    def at_least(self, probability: float) -> PictureResult:
        """With the detections that are at least so probable."""
        return replace(self, detections=tuple(one for one in self.detections if one.probability >= probability))


class PictureDetector:
    """Single-frame detection. May be used for pictures of several sizes."""

    def __init__(self, config: PerceptionConfig | None = None, networks: Networks | None = None) -> None:
        """``config``: by default flockd's own networks; whatever it says, the scale is the networks', without flow,
        and a drone is found at any range: what a picture shows does not depend on how long the lens is.

        ``networks`` may be shared; None: those that the configuration names. Raises ModelError.
        """
        given = config or PerceptionConfig()
        any_range = given.detection.model_copy(update={"max_range_m": _ANY_RANGE_M})
        self._config = given.model_copy(update={"flow": DIS, "scale": "network", "detection": any_range})
        self._networks = networks or load_networks(self._config)
        self._mounted: RigCamera | None = None

    def detect(self, image: UInt8Array, camera: Camera | None = None, *, fov_deg: float | None = None) -> PictureResult:
        """Drones in one picture.

        Args:
            image: (h, w, 3) RGB, 8 bits.
            camera: of the picture, of the picture's size or of the size that it is to be resized to; or
            fov_deg: instead of it: field of view across the longer side, as for `camera_with_fov`.

        Raises ValueError for what is no such image, and where not one of ``camera`` and ``fov_deg`` is given.
        """
        if not isinstance(image, np.ndarray) or image.shape[2:] != (3,) or image.dtype != np.uint8:
            given = f"{image.dtype} of the shape {image.shape}" if isinstance(image, np.ndarray) else repr(image)[:60]
            raise ValueError(
                f"a picture must be an RGB array (height, width, 3) of uint8, not {given}; "
                "cv2.imread gives None for a file that it cannot read"
            )
        height, width = image.shape[:2]
        if (camera is None) == (fov_deg is None):
            raise ValueError("the picture's camera must be given, or its field of view as fov_deg, and not both")
        if camera is None:
            assert fov_deg is not None
            camera = camera_with_fov((width, height), fov_deg)
        scale = np.array(camera.size) / (width, height)
        if camera.size != (width, height):
            image = np.asarray(cv2.resize(image, camera.size, interpolation=cv2.INTER_AREA), np.uint8)
        if self._mounted is None or self._mounted.camera is not camera:  # one object, as rays are cached by it
            self._mounted = RigCamera("camera", camera, RigidTransform(R_FRD_RDF, np.zeros(3)))
        config = self._config
        frames = FrameSet(0.0, {"camera": Frame("camera", np.ascontiguousarray(image), 0.0, 0)})
        while True:
            trace, perception = DetectionTrace(), Perception(Rig({"camera": self._mounted}), self._networks, config)
            observation = perception.observe(frames, VehicleState(0.0, np.eye(3), _UNKNOWN_HEIGHT_M), None, trace=trace)
            most = config.detection.max_proposals
            if 2 * len(observation.detections) < most or len(trace.proposals) < most:
                break
            more = config.detection.model_copy(update={"max_proposals": 2 * most})  # a swarm: as many as it needs
            config = config.model_copy(update={"detection": more})
        if "camera" not in observation.cameras:  # the networks' output was not finite
            return PictureResult((), 0, np.zeros(image.shape[:2], np.uint8))
        seen, least = observation.cameras["camera"].labels, self._networks.second_stage.drone_probability
        sure = [one for one in observation.detections if one.drone_probability >= least]
        mask = np.where(np.isin(seen, [one.label for one in sure]), seen, np.uint8(0))
        found = tuple(self._drone(one, camera, mask, trace.candidates, scale) for one in sure)
        return PictureResult(found, sum(proposal.instance is not None for proposal in trace.proposals), mask)

    def _drone(
        self, one: Detection, camera: Camera, mask: UInt8Array, candidates: Sequence[Candidate], scale: FloatArray
    ) -> DetectedDrone:
        """With pixels of the picture before it was resized by ``scale`` (2,)."""
        size_px = one.size_m / one.range_m * camera.focal_px
        mine = [c for c in candidates if angles_between(c.bearing, one.bearing) < one.size_m / one.range_m / 2]
        instances = [c.proposal.instance for c in mine if c.proposal.instance is not None]
        boxed = max((i for i in instances if i.boxed), key=lambda instance: instance.score, default=None)
        if boxed is not None:
            boxes = [boxed.box]
        else:
            boxes = [i.box for i in instances if (i.box[2:] - i.box[:2]).max() <= _MAX_INSTANCE * size_px]
            left, top, wide, high = cv2.boundingRect((mask == one.label).astype(np.uint8))
            boxes += [np.array([left, top, left + wide, top + high], np.float64)] if wide else []
        if not boxes:  # no mask, or a nearer drone's covers it
            centre = camera.project(one.position[None] @ R_FRD_RDF)[0]
            boxes.append(np.clip([*(centre - size_px / 2), *(centre + size_px / 2)], 0, np.tile(camera.size, 2)))
        box = np.concatenate([np.min(boxes, axis=0)[:2], np.max(boxes, axis=0)[2:]])
        x0, y0, x1, y1 = (float(value) for value in box / np.tile(scale, 2))
        said = self._config.drone_size_m is not None
        known = said or one.log_size_sigma < KNOWN_LOG_SIZE_SIGMA
        sigma = one.range_sigma_m if known else math.hypot(one.way_sigma_m, one.range_m * UNKNOWN_LOG_SIZE_SIGMA)
        return DetectedDrone(
            box=(x0, y0, x1, y1),
            probability=one.drone_probability,
            range_m=one.range_m,
            range_sigma_m=sigma,
            size_m=one.size_m,
            size_sigma_m=self._config.drone_size_sigma_m if said else one.size_m * sigma / one.range_m,
            kind_known=known,
            label=one.label,
        )


@lru_cache(maxsize=8)  # one object for pictures of one size, as rays are cached by it
def camera_with_fov(size: tuple[int, int], fov_deg: float) -> Camera:
    """A camera of a picture's size or, for a larger one, of the size to resize it to.

    Without distortion up to `WIDEST_PINHOLE_DEG`, and an equidistant fisheye beyond: a lens without distortion draws a
    drone at 60 degrees off its axis twice as long as wide, and hardly one is built.

    Args:
        size: width and height of the picture.
        fov_deg: field of view across the longer side, as of a phone that is held either way.
    """
    longer = max(size)
    if longer > MAX_SIDE_PX:
        size = (max(round(size[0] * MAX_SIDE_PX / longer), 1), max(round(size[1] * MAX_SIDE_PX / longer), 1))
    half_rad, is_pinhole = math.radians(fov_deg) / 2, fov_deg <= WIDEST_PINHOLE_DEG
    focal = max(size) / 2 / (math.tan(half_rad) if is_pinhole else half_rad)
    matrix = np.array([[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]])
    return PinholeCamera(matrix, size) if is_pinhole else WideAngleCamera(matrix, size)

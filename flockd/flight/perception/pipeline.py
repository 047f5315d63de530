"""Perception: a frame set in, an observation out; images to maps, flow, metric depth, detections and masks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from flockd.core.config.perception import PerceptionConfig
from flockd.core.messages import Float32Array, FloatArray, Frame, FrameSet, GroundEstimate, VehicleState
from flockd.flight.geometry import Rig, ground_inverse_depth
from flockd.flight.perception.continuity import ContinuityMonitor
from flockd.flight.perception.depth import GroundBelow, NoGround, fix_by_height
from flockd.flight.perception.detection.detector import DetectionTrace, Detector
from flockd.flight.perception.detection.masks import depth_of_drones, without_borders
from flockd.flight.perception.image_noise import NoiseMonitor
from flockd.flight.perception.interface import Networks
from flockd.flight.perception.maps import KnownSize, SceneMaps
from flockd.flight.perception.observation import CameraObservation, Observation
from flockd.flight.tracking import Prediction

Reasons = list[str]


class Perception:
    """One drone's perception. Remembers the last observation; the networks may serve several drones."""

    def __init__(self, rig: Rig, networks: Networks, config: PerceptionConfig) -> None:
        self._rig, self._networks, self._config = rig, networks, config
        size_m = config.drone_size_m
        known_size = None if size_m is None else KnownSize(size_m, config.drone_size_sigma_m)
        self._detector = Detector(rig, networks, config.detection, known_size)
        self._ground = GroundBelow(config.height, config.range_finder) if config.scale == "height" else None
        self._noise = NoiseMonitor(config.noise)
        self._continuity = ContinuityMonitor(config.noise)
        self._last: Observation | None = None

    def observe(
        self,
        frames: FrameSet,
        vehicle: VehicleState,
        predictions: Sequence[Prediction] = (),
        trace: DetectionTrace | None = None,
        lap: Callable[[str], None] = lambda stage: None,
    ) -> Observation:
        """What the newest frame set shows.

        Args:
            frames: the newest image of every camera that has one.
            vehicle: what the own autopilot says, at the frames' time.
            predictions: where tracks should be; the detector searches there too.
            trace: filled with what the detector went through, where a caller wants to see it.
            lap: called at the end of each stage with its name, to time it.
        """
        usable, noisy, unusable = self._usable(frames, vehicle)
        ground, ungrounded = self._ground_at(vehicle)
        scenes, failed = self._scenes(usable, vehicle, ground)
        lap("scene")
        previous, restarted = self._pair(frames)
        flows = self._flows(previous, {name: usable[name] for name in scenes})
        lap("flow")
        images = {name: usable[name].image for name in scenes}
        detections, masks = self._detector.detect(images, scenes, vehicle, predictions, trace or DetectionTrace())
        cameras = {}
        for name, scene in scenes.items():
            depth = depth_of_drones(scene.depth, masks[name], self._rig.cameras[name], detections)
            labels = without_borders(masks[name], self._config.detection.mask_border_px)
            cameras[name] = CameraObservation(images[name], depth, labels, flows.get(name))
        reasons = (*unusable, *ungrounded, *failed, *restarted)
        found = ground if isinstance(ground, GroundEstimate) and self._config.height != "barometer" else None
        track = None if found is None or self._ground is None else self._ground.track(vehicle)
        self._last = Observation(frames.time_s, vehicle, cameras, detections, previous, reasons, noisy, found, track)
        lap("detection")
        return self._last

    def see_slope(self, slope: FloatArray) -> None:
        """Takes the ground's slope (2,) at the newest observation, as the own motion showed it, for the next ones."""
        if self._ground is not None:
            self._ground.see_slope(slope)

    def _usable(self, frames: FrameSet, vehicle: VehicleState) -> tuple[dict[str, Frame], tuple[str, ...], Reasons]:
        """The frames of the rig's cameras that have the right size and show a scene, and whose show noise or damage."""
        usable, noisy, reasons = {}, [], []
        for name, camera in self._rig.cameras.items():
            width, height = camera.camera.size
            frame = frames.frames.get(name)
            if frame is None:
                reasons.append(f"camera {name}: no frame")
            elif frame.image.shape != (height, width, 3):
                found = f"{frame.image.shape[1]}x{frame.image.shape[0]}"
                reasons.append(f"camera {name}: its image is {found} and not {width}x{height}")
            elif self._noise.is_noisy(name, frame.image, frames.time_s):
                noisy.append(name)
                reasons.append(f"camera {name}: its image is noise")
            else:
                usable[name] = frame
        images = {name: frame.image for name, frame in usable.items()}
        for name in self._continuity.broken(images, frames.time_s, vehicle.R_ned_body):
            noisy.append(name)
            reasons.append(f"camera {name}: its image does not follow from the one before")
            del usable[name]
        return usable, tuple(noisy), reasons

    def _ground_at(self, vehicle: VehicleState) -> tuple[GroundEstimate | NoGround | None, Reasons]:
        """The ground where the height is to give the scale, and what was wrong with its source; None: it is not to."""
        if self._ground is None:
            return None, []
        ground, fallback = self._ground.update(vehicle)
        if isinstance(ground, NoGround):
            return ground, [ground.reason]
        return ground, [] if fallback is None else [fallback]

    def _scenes(
        self, frames: Mapping[str, Frame], vehicle: VehicleState, ground: GroundEstimate | NoGround | None
    ) -> tuple[dict[str, SceneMaps], Reasons]:
        """The networks' maps of every camera, with the scale that the ground gives where it is to give it."""
        scenes, reasons = {}, []
        for name, frame in frames.items():
            camera = self._rig.cameras[name]
            try:
                plane = None
                if isinstance(ground, GroundEstimate):
                    stride, slope = self._networks.map_stride, (float(ground.slope[0]), float(ground.slope[1]))
                    R_ned_body = vehicle.R_ned_body
                    plane = ground_inverse_depth(camera, R_ned_body, ground.height_m, stride=stride, slope=slope)
                scene = self._networks.scene(frame, camera, plane)
                if isinstance(ground, NoGround):
                    scene = replace(scene, depth=np.full_like(scene.depth, np.nan), open=None)
                scenes[name] = scene if plane is None else fix_by_height(scene, plane)
            except (FloatingPointError, ValueError) as error:  # an output that is not finite; a height below the ground
                reasons.append(f"camera {name}: {error}")
        return scenes, reasons

    def _pair(self, frames: FrameSet) -> tuple[Observation | None, Reasons]:
        """The observation before, unless time runs backwards."""
        if self._last is None:
            return None, []
        if frames.time_s <= self._last.time_s:
            return None, ["time stamps do not increase: the pair starts anew"]
        return replace(self._last, previous=None), []

    def _flows(self, previous: Observation | None, frames: Mapping[str, Frame]) -> dict[str, Float32Array]:
        """By camera, from the image before to this one."""
        if previous is None:
            return {}
        flows = {}
        for name, frame in frames.items():
            before = previous.cameras.get(name)
            if before is not None:
                first = Frame(name, before.image, previous.time_s, 0)
                flows[name] = self._networks.flow(first, frame, before.labels)
        return flows

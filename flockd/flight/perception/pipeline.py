"""Perception: a frame set in, an observation out: maps, flow, metric depth, detections and masks."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import replace

from flockd.core.config.perception import PerceptionConfig
from flockd.core.messages import (
    Float32Array,
    Frame,
    FrameSet,
    GroundEstimate,
    LearnedSize,
    Reason,
    ReasonKind,
    VehicleState,
)
from flockd.flight.geometry import RangeMap, Rig, ground_inverse_depth, range_map
from flockd.flight.perception.detection.detector import DetectionTrace, Detector, without_borders
from flockd.flight.perception.image_monitor import ImageMonitor
from flockd.flight.perception.interface import ImagePair, ImageView, Networks, SceneMaps
from flockd.flight.perception.observation import CameraObservation, Observation
from flockd.flight.tracking import Prediction

Reasons = list[Reason]


class Perception:
    """One drone's perception. Several drones may share the networks."""

    def __init__(self, rig: Rig, networks: Networks, config: PerceptionConfig) -> None:
        self._rig, self._networks, self._config = rig, networks, config
        size_m = config.drone_size_m
        self._said_size = None if size_m is None else LearnedSize(size_m, config.drone_size_sigma_m / size_m)
        self._detector = Detector(rig, networks, config.detection)
        self._needs_ground = config.scale == "height"
        self._monitor = ImageMonitor(rig.cameras, config.noise)
        self.last: Observation | None = None
        """The newest observation; the next one's flow starts from it."""

    def observe(
        self,
        frames: FrameSet,
        vehicle: VehicleState,
        ground: GroundEstimate | None,
        predictions: Sequence[Prediction] = (),
        trace: DetectionTrace | None = None,
        lap: Callable[[str], None] = lambda stage: None,
        learned_size: LearnedSize | None = None,
        resting: Container[str] = (),
    ) -> Observation:
        """The observation of the newest frame set.

        Args:
            frames: the newest image of every camera that has one.
            vehicle: the own autopilot's state at the frames' time.
            ground: below the drone. `scale: height` needs it for depth; otherwise it is not used.
            predictions: expected positions of tracks; the detector searches there too.
            trace: filled with the detector's intermediate results.
            lap: called at the end of each stage with its name, to time it.
            learned_size: of every drone, if the configuration gives none; None: the network estimates each one's.
            resting: cameras that are not looked at in this step.
        """
        usable, noisy, without_image = self._usable(frames, vehicle, resting)
        scenes, depths, without_scene = self._scenes(usable, vehicle, ground)
        lap("scene")
        previous, without_pair = self._pair(frames)
        flows, without_flow = self._flows(previous, {name: usable[name] for name in scenes})
        lap("flow")
        images = {name: usable[name].image for name in scenes}
        size = self._said_size or learned_size
        found = self._detector.detect(images, scenes, vehicle, predictions, trace or DetectionTrace(), size)
        cameras = {}
        for name, mask in found.masks.items():
            labels = without_borders(mask, self._config.detection.mask_border_px)
            cameras[name] = CameraObservation(images[name], depths.get(name), labels, flows.get(name))
        reasons = (*without_image, *without_scene, *without_pair, *without_flow, *found.reasons)
        self.last = Observation(frames.time_s, vehicle, cameras, found.detections, previous, reasons, noisy)
        lap("detection")
        return self.last

    def _usable(
        self, frames: FrameSet, vehicle: VehicleState, resting: Container[str]
    ) -> tuple[dict[str, Frame], tuple[str, ...], Reasons]:
        """Usable frames, cameras whose frames are noise, damaged or unclear, and the reasons."""
        usable, reasons = {}, []
        for name, camera in self._rig.cameras.items():
            width, height = camera.camera.size
            frame = frames.frames.get(name)
            if name in resting:
                continue
            if frame is None:
                reasons.append(_of_camera(name, "no frame"))
            elif frame.image.shape != (height, width, 3):
                found = f"{frame.image.shape[1]}x{frame.image.shape[0]}"
                reasons.append(_of_camera(name, f"its image is {found} and not {width}x{height}"))
            else:
                usable[name] = frame
        images = {name: frame.image for name, frame in usable.items()}
        faults = self._monitor.faults(images, frames.time_s, vehicle.R_ned_body)
        for name in faults:
            del usable[name]
        return usable, tuple(faults), [*reasons, *faults.values()]

    def _scenes(
        self, frames: Mapping[str, Frame], vehicle: VehicleState, ground: GroundEstimate | None
    ) -> tuple[dict[str, SceneMaps], dict[str, RangeMap], Reasons]:
        """The networks' maps of every camera, and metric depth of those that have it."""
        views, scenes, depths, reasons = {}, {}, {}, []
        for name, frame in frames.items():
            try:
                views[name] = ImageView(frame, self._rig.cameras[name], self._plane(name, vehicle, ground))
            except ValueError as error:  # a height below the ground
                reasons.append(_of_camera(name, str(error)))
        for (name, view), scene in zip(views.items(), self._networks.scenes(list(views.values())), strict=True):
            if isinstance(scene, Exception):
                reasons.append(_of_camera(name, str(scene)))
                continue
            scenes[name] = scene
            if view.ground is not None or not self._needs_ground:
                depths[name] = range_map(scene.depth, view.camera.camera)
        return scenes, depths, reasons

    def _plane(self, camera: str, vehicle: VehicleState, ground: GroundEstimate | None) -> Float32Array | None:
        """The inverse depth of the ground at the maps' stride; None: not known. Raises ValueError."""
        if ground is None or not self._needs_ground:
            return None
        mounted, stride = self._rig.cameras[camera], self._networks.map_stride
        return ground_inverse_depth(mounted, vehicle.R_ned_body, ground.height_m, ground.slope, stride=stride)

    def _pair(self, frames: FrameSet) -> tuple[Observation | None, Reasons]:
        """The observation before; None if time runs backwards."""
        if self.last is None:
            return None, []
        if frames.time_s <= self.last.time_s:
            return None, [Reason(ReasonKind.PAIR, "time stamps do not increase: the pair starts anew")]
        return replace(self.last, previous=None), []

    def _flows(
        self, previous: Observation | None, frames: Mapping[str, Frame]
    ) -> tuple[dict[str, Float32Array], Reasons]:
        """Flow by camera, from the image before to this one."""
        if previous is None:
            return {}, []
        pairs = {}
        for name, frame in frames.items():
            before = previous.cameras.get(name)
            if before is not None:
                pairs[name] = ImagePair(Frame(name, before.image, previous.time_s, 0), frame, before.labels)
        found = dict(zip(pairs, self._networks.flows(list(pairs.values())), strict=True))
        flows = {name: flow for name, flow in found.items() if not isinstance(flow, Exception)}
        return flows, [_of_camera(name, str(error)) for name, error in found.items() if isinstance(error, Exception)]


def _of_camera(name: str, text: str) -> Reason:
    return Reason(ReasonKind.CAMERA, f"camera {name}: {text}")

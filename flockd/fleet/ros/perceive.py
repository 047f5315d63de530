"""Perception alone, for other software: computes neighbours from images, and commands nothing."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.errors import UsageError
from flockd.core.messages import PilotOutput, VehicleState
from flockd.fleet.ros import message_trees as trees
from flockd.fleet.ros.message_trees import Names, ros_name
from flockd.fleet.ros.ros_input import STATES, NearestState, check_height, state_stamp_ns, vehicle_state
from flockd.fleet.ros.ros_node import Delivery, RosNode
from flockd.flight.pilot import FlockPilot
from flockd.onboard.daemon import load_side_by_side
from flockd.onboard.sources import FrameSource
from flockd.onboard.telemetry.step_messages import neighbour_message

_LOOK_S = 0.2
_TELL_S = 1.0


def check(config: DroneConfig, vehicle_topic: str | None) -> None:
    """Raises UsageError if the configuration needs a height and no topic gives one."""
    if vehicle_topic is None and config.perception.scale == "height":
        raise UsageError(
            "perception.scale: is `height`, which needs a height; name odometry or a pose with --vehicle, or "
            "write `scale: network`"
        )


class PerceptionNode:
    """Detects and tracks drones in the images of a source, and publishes them.

    Without the vehicle's state it assumes that the drone is level and faces north: y of `DRONE/level` is then ahead,
    and x to the right. Call `check` first.
    """

    def __init__(self, config: DroneConfig, node: RosNode, vehicle_topic: str | None) -> None:
        """The caller closes ``node``. Raises ModelError."""
        self._config, self._node, self._vehicle_topic = config, node, vehicle_topic
        self._names = Names(ros_name(config.name))
        self._pilot = FlockPilot(config, load_side_by_side(config), stopwatch=time.perf_counter)
        self._states: NearestState | None = None
        self._last_s, self._told_s = -np.inf, -np.inf

    def run(self, source: FrameSource) -> None:
        """Runs without end."""
        # Frames that come a little early belong to the step.
        slack_s = 0.0 if self._config.source is None else self._config.source.set_tolerance_s
        source.start()
        try:
            while True:
                frames = source.newest(_LOOK_S)
                vehicle = None if frames is None else self._vehicle(frames.time_s)
                if frames is None or frames.time_s < self._last_s + self._config.step_s - slack_s:
                    self._tell(source, [] if frames else None)
                elif vehicle is None:
                    self._tell(source, [self._missing()])
                else:
                    self._last_s = frames.time_s
                    output = self._pilot.step(frames, vehicle)
                    self._publish(output)
                    self._tell(source, [reason.text for reason in output.reasons])
        finally:
            source.stop()

    def _vehicle(self, time_s: float) -> VehicleState | None:
        """The vehicle's state; the type of its topic is known only when the topic exists."""
        if self._vehicle_topic is None:
            return VehicleState(time_s, np.eye(3), 0.0)
        if self._states is None:
            kind = next((kind for kind in self._node.kinds(self._vehicle_topic) if kind in STATES), None)
            if kind is None:
                return None
            check_height(self._vehicle_topic, kind, self._config)
            self._states = NearestState()
            take = partial(_take_state, self._states, kind)
            self._node.subscribe(self._vehicle_topic, kind, take, Delivery.SENSOR)
        return self._states.at(time_s + self._config.rig.time_offset_s)

    def _missing(self) -> str:
        """Why no state of the vehicle is known."""
        if self._states is not None:
            return f"no state of {self._vehicle_topic} is near the images' time; are their stamps of one clock?"
        there = ", ".join(self._node.kinds(self._vehicle_topic or "")) or "not published"
        return f"{self._vehicle_topic} is {there}; name one of {', '.join(STATES)} with --vehicle"

    def _publish(self, output: PilotOutput) -> None:
        """Publishes neighbours, with the stamp of the images."""
        time_ns = round(1e9 * output.time_s) + time.time_ns() - time.monotonic_ns()
        seen, space = [neighbour_message(one) for one in output.neighbours], f"/{self._names.drone}"
        poses, tracks = (make(time_ns, self._names, seen) for make in (trees.neighbour_poses, trees.tracks))
        self._node.publish(f"{space}/neighbours", trees.POSE_ARRAY, poses, Delivery.SENSOR)
        self._node.publish(f"{space}/neighbours/tracks", trees.POINT_CLOUD, tracks, Delivery.SENSOR)

    def _tell(self, source: FrameSource, reasons: Sequence[str] | None) -> None:
        """Publishes faults once a second. ``reasons``: None: no images come."""
        now_s = time.monotonic()
        if now_s - self._told_s < _TELL_S:
            return
        self._told_s = now_s
        faults = [status.fault for status in source.status().values() if status.fault]
        matters = [*faults, *(["no images have come yet"] if reasons is None and not faults else reasons or [])]
        level = trees.ERROR if reasons is None and self._last_s == -np.inf else trees.WARN if matters else trees.OK
        status = trees.diagnostic(f"{self._names.drone}: perception", level, "; ".join(matters) or "sees", {})
        tree = trees.diagnostics(time.time_ns(), [status])
        self._node.publish(f"/{self._names.drone}/diagnostics", trees.DIAGNOSTICS, tree, Delivery.STATE)


def _take_state(states: NearestState, kind: str, message: Any) -> None:
    now_ns = time.time_ns()
    true_ns, _ = state_stamp_ns(kind, message, now_ns)
    states.add(vehicle_state(kind, message, 1e-9 * (true_ns + time.monotonic_ns() - now_ns)))

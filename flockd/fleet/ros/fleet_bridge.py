"""Publishes a fleet's telemetry in ROS 2, and takes orders from there. No drone waits for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from flockd.fleet.drone_rows import GONE, QUIET, Known, Row
from flockd.fleet.live_fleet import LiveFleet
from flockd.fleet.ros import message_trees as trees
from flockd.fleet.ros.fleet_markers import home_in_map, markers
from flockd.fleet.ros.message_trees import Names, Tree, ros_name
from flockd.fleet.ros.ros_frames import MAP, attitude_in_ros
from flockd.fleet.ros.ros_node import Delivery, RosNode, has_type
from flockd.fleet.ros.ros_orders import goal_of, velocity_of
from flockd.fleet.watcher import Watched
from flockd.onboard.telemetry.topics import OrderMessage, StateMessage

UPDATE_EVERY_S = 0.05
STATE_EVERY_S = 1.0
"""Interval at which a drone's state is sent; it is also sent when it changes."""
PLAIN = ("hold", "land", "resume")
"""Orders without values; each is a service."""
_LEVELS = {
    **dict.fromkeys(("normal", "ready", "idle"), trees.OK),
    **dict.fromkeys(("degraded", "hover", "silent"), trees.WARN),
    **dict.fromkeys(("asking", GONE), trees.ERROR),
    QUIET: trees.STALE,
}
_VALUES = (
    "flight_mode", "armed", "in_air", "height_m", "speed_m_s", "battery_share", "mission", "neighbours", "rate_hz",
    "load", "temperature_c", "setpoints_missed", "messages_lost", "delay_ms", "clock_s", "recording", "silence",
    "version",
)  # fmt: skip
"""Values of a row of the fleet page that a drone's DiagnosticStatus holds."""


class FleetBridge:
    """Publishes between ``__enter__`` and ``__exit__``, on a separate thread."""

    def __init__(self, source: LiveFleet, node: RosNode, *, may_command: bool, operator: str) -> None:
        """The caller closes ``source`` and ``node``. ``may_command``: whether orders are passed on, in the name of
        ``operator``."""
        self._source, self._node, self._may_command, self._operator = source, node, may_command, operator
        self._names = DroneNames()
        self.has_transforms = has_type(trees.TRANSFORMS)
        """Whether this ROS 2 has `tf2_msgs`; without it there is no `/tf`."""
        self._sent: dict[tuple[str, str], float] = {}
        self._told: dict[str, tuple[float, Tree]] = {}
        self._drawn: dict[str, Row] = {}
        self._served: set[str] = set()
        self._over = threading.Event()
        self._thread = ThreadPoolExecutor(1, "fleet in ROS 2")

    def __enter__(self) -> FleetBridge:
        self._publishing = self._thread.submit(self._publish)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.shutdown()

    def wait(self) -> None:
        """Waits until it is closed. Raises the error that ended it."""
        self._publishing.result()

    def _publish(self) -> None:
        while not self._over.wait(UPDATE_EVERY_S):
            self.update()

    def update(self) -> None:
        """Publishes new messages."""
        now_s = self._source.now_s()
        rows = self._source.rows(now_s)
        for drone in self._source.drones():
            key = f"{drone.fleet}/{drone.drone}"
            name, row = self._names.of(key), rows.get(key)
            if row is None:
                continue
            if self._may_command and name not in self._served:
                self._served.add(name)
                self._serve(key, name)
            self._publish_step(drone, name, row, now_s)
            self._publish_state(name, row, now_s)
            self._publish_markers(name, row)

    def _publish_step(self, drone: Watched, name: str, row: Row, now_s: float) -> None:
        """Publishes the messages of each step of the drone's pilot, once."""
        for topic in ("state", "neighbours", "obstacles"):
            heard, message = drone.topics.get(topic), drone.message(topic, now_s)
            if heard is None or message is None or self._sent.get((name, topic)) == heard.time_s:
                continue
            self._sent[name, topic] = heard.time_s
            time_ns = round(1e9 * self._source.wall_s(heard.time_s))
            for place, kind, tree in self._of_step(topic, time_ns, Names(name), message, row):
                if tree is not None:
                    self._node.publish(place, kind, tree, Delivery.SENSOR if place != "/tf" else Delivery.EVENT)

    def _of_step(
        self, topic: str, time_ns: int, names: Names, message: Any, row: Row
    ) -> list[tuple[str, str, Tree | None]]:
        space = f"/{names.drone}"
        match topic:
            case "neighbours":
                seen = message["neighbours"]
                return [
                    (f"{space}/neighbours", trees.POSE_ARRAY, trees.neighbour_poses(time_ns, names, seen)),
                    (f"{space}/neighbours/tracks", trees.POINT_CLOUD, trees.tracks(time_ns, names, seen)),
                ]
            case "obstacles":
                return [(f"{space}/obstacles", trees.LASER_SCAN, trees.scan(time_ns, names, message))]
        frames = _transforms(time_ns, names, message, row) if self.has_transforms else None
        return [
            (f"{space}/odometry", trees.ODOMETRY, trees.state_odometry(time_ns, names, message)),
            ("/tf", trees.TRANSFORMS, frames),
        ]

    def _publish_state(self, name: str, row: Row, now_s: float) -> None:
        status = _status(name, row)
        told_s, told = self._told.get(name, (-STATE_EVERY_S, {}))
        changed = (status["level"], status["message"]) != (told.get("level"), told.get("message"))
        if not changed and now_s - told_s < STATE_EVERY_S:
            return
        self._told[name] = now_s, status
        tree = trees.diagnostics(round(1e9 * self._source.wall_s(now_s)), [status])
        self._node.publish(f"/{name}/diagnostics", trees.DIAGNOSTICS, tree, Delivery.STATE)
        self._node.publish("/diagnostics", trees.DIAGNOSTICS, tree, Delivery.EVENT)

    def _publish_markers(self, name: str, row: Row) -> None:
        topic = f"/{name}/markers"
        self._node.advertise(topic, trees.MARKERS, Delivery.STATE)
        if self._drawn.get(name) != row:
            self._drawn[name] = row
            time_ns = round(1e9 * self._source.wall_s(self._source.now_s()))
            number = list(self._drawn).index(name)
            self._node.publish(topic, trees.MARKERS, markers(time_ns, name, number, row), Delivery.STATE)

    def _serve(self, key: str, name: str) -> None:
        """Makes a drone's services, and the topics of orders with values."""
        for command in PLAIN:
            self._node.serve(f"/{name}/{command}", partial(self._ask, key, command, None))
        for topic, kind, command, parse in (
            ("goal", trees.POSE, "goto", goal_of),
            ("cmd_vel", trees.TWIST, "velocity", velocity_of),
        ):
            take = partial(self._order, key, name, command, parse)
            self._node.subscribe(f"/{name}/{topic}", kind, take, Delivery.ORDER)
        self._node.advertise(f"/{name}/order_answer", trees.DIAGNOSTIC, Delivery.EVENT)

    def _order(self, key: str, name: str, command: str, parse: Callable[..., OrderMessage], message: Any) -> None:
        """Publishes the drone's answer, as a topic has no reply."""
        row, known = self._source.rows(self._source.now_s()).get(key), self._source.known().get(key, Known())
        try:
            if row is None:
                raise ValueError("the drone does not send any more")  # noqa: TRY301 - told below
            accepted, sentence = self._ask(key, command, parse(message, Names(name), row, known.about))
        except ValueError as error:
            accepted, sentence = False, str(error)
        level = trees.OK if accepted else trees.ERROR
        told = trees.diagnostic(f"{name}: {command}", level, sentence, {"accepted": accepted})
        self._node.publish(f"/{name}/order_answer", trees.DIAGNOSTIC, told, Delivery.EVENT)

    def _ask(self, key: str, command: str, order: OrderMessage | None) -> tuple[bool, str]:
        """Sends a command to the drone, which decides."""
        answer = self._source.ask(key, command, None if order is None else dict(order), self._operator)
        return answer["accepted"], answer["sentence"]


class DroneNames:
    """A fixed namespace for each drone, by its key `fleet/drone`."""

    def __init__(self) -> None:
        self._names: dict[str, str] = {}

    def of(self, key: str) -> str:
        """The drone's name; with its fleet's, or a number, if another drone already has the name."""
        if key not in self._names:
            short, whole = ros_name(key.partition("/")[2]), ros_name(key)
            taken = set(self._names.values())
            numbered = (f"{whole}_{number}" for number in range(2, len(taken) + 3))
            self._names[key] = next(name for name in (short, whole, *numbered) if name not in taken)
        return self._names[key]


def _transforms(time_ns: int, names: Names, state: StateMessage, row: Row) -> Tree | None:
    """Transforms of map, odom, level and body, for a drone that knows its position."""
    odometry = trees.state_odometry(time_ns, names, state)
    if odometry is None:
        return None
    place = np.array(list(odometry["pose"]["pose"]["position"].values()))
    return {
        "transforms": [
            trees.transform(time_ns, MAP, names.odom, home_in_map(row), np.eye(3)),
            trees.transform(time_ns, names.odom, names.level, place, np.eye(3)),
            trees.transform(
                time_ns, names.odom, names.base_link, place, attitude_in_ros(trees.attitude_of_state(state))
            ),
        ]
    }


def _status(name: str, row: Row) -> Tree:
    """Level, state and reasons; the camera's faults are among the reasons."""
    sentence = ": ".join([row["state"], *filter(None, ["; ".join(row["why"])])])
    values = {"state": row["state"], **{one: row[one] for one in _VALUES}}
    return trees.diagnostic(f"{name}: flockd", _LEVELS[row["state"]], sentence, values)

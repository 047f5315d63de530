"""The adapter of rclpy, ROS 2's client library: a node that publishes, subscribes and serves trees of plain values.

rclpy comes with a sourced ROS 2, or from PyPI with the extra `ros`. Callbacks run on threads of the node.
"""

from __future__ import annotations

import importlib
import os
import re
import threading
from array import array
from collections.abc import Callable, Mapping
from enum import Enum, auto
from typing import Any, Self

import numpy as np

from flockd.core.errors import UnavailableError
from flockd.fleet.ros.message_trees import Tree

HERE_ONLY = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
"""Environment of a node that only nodes of this computer find, because ROS 2 has no access rules."""
NOT_INSTALLED = "there is no rclpy; source a ROS 2, or, with Python 3.11 on x86-64 Linux, pip install -e '.[ros]'"
_THREADS = 64
"""Threads for callbacks: an order may wait some seconds for a silent drone."""
_TRIGGER = "std_srvs/srv/Trigger"
_ELEMENT = re.compile(r"(?:sequence<)?([a-z0-9_]+/\w+)(?:, \d+)?>?(?:\[\d*\])?")


class Delivery(Enum):
    """QoS of a topic."""

    SENSOR = auto()
    """Best effort, the newest five, as for sensors."""
    STATE = auto()
    """Reliable and transient local: a late subscriber gets the newest message."""
    EVENT = auto()
    """Reliable, the newest ten."""
    ORDER = auto()
    """Reliable, only the newest: older messages that wait are dropped."""


class RosNode:
    """A node between ``__enter__`` and ``__exit__``. Raises UnavailableError without ROS 2."""

    def __init__(self, name: str, *, here_only: bool) -> None:
        """``here_only``: other computers do not find it, unless the environment already sets the discovery range."""
        if here_only and "ROS_LOCALHOST_ONLY" not in os.environ:
            for key, value in HERE_ONLY.items():
                os.environ.setdefault(key, value)
        rclpy = _rclpy()
        from rclpy.executors import MultiThreadedExecutor  # noqa: PLC0415 - of an extra
        from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415

        self._context = rclpy.Context()
        try:
            rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            self._node = rclpy.create_node(name, context=self._context)
        except Exception as error:  # of pybind11's own types: RCLError and others
            raise UnavailableError(
                f"ROS 2 cannot start ({str(error).splitlines()[0]}); check its environment"
            ) from error
        self._executor = MultiThreadedExecutor(num_threads=_THREADS, context=self._context)
        self._executor.add_node(self._node)
        self._publishers: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._spin, name="ROS 2", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown(timeout_sec=1.0)
        self._context.try_shutdown()
        self._thread.join(5.0)

    def advertise(self, topic: str, kind: str, delivery: Delivery) -> None:
        """Makes a topic's publisher, if there is none yet."""
        with self._lock:
            if topic not in self._publishers:
                self._publishers[topic] = self._node.create_publisher(_type(kind), topic, _profile(delivery))

    def publish(self, topic: str, kind: str, tree: Tree, delivery: Delivery) -> None:
        """Publishes one message; makes the publisher first."""
        self.advertise(topic, kind, delivery)
        self._publishers[topic].publish(_message(_type(kind), tree))

    def kinds(self, topic: str) -> list[str]:
        """Types of a topic's current publishers."""
        return sorted({one.topic_type for one in self._node.get_publishers_info_by_topic(topic)})

    def subscribe(self, topic: str, kind: str, take: Callable[[Any], None], delivery: Delivery) -> None:
        """Calls ``take`` with each message of rclpy, one at a time, on a thread of the node. It may wait."""
        self._node.create_subscription(_type(kind), topic, take, _profile(delivery), callback_group=_one_at_a_time())

    def serve(self, name: str, answer: Callable[[], tuple[bool, str]]) -> None:
        """Makes a Trigger service; ``answer`` returns whether it succeeded, and a sentence. It may wait."""

        def respond(_: Any, response: Any) -> Any:
            response.success, response.message = answer()
            return response

        self._node.create_service(_type(_TRIGGER), name, respond, callback_group=_one_at_a_time())

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException  # noqa: PLC0415

        try:
            self._executor.spin()
        except ExternalShutdownException:
            return


def has_type(kind: str) -> bool:
    """Whether this ROS 2 has a message type; the wheels of PyPI lack a few."""
    try:
        _type(kind)
    except UnavailableError:
        return False
    return True


def _rclpy() -> Any:
    """Imports rclpy. Raises UnavailableError if it is missing or made for another Python."""
    try:
        import rclpy  # noqa: PLC0415 - of an extra, or of a ROS 2 that is sourced
    except ImportError as error:
        if getattr(error, "name", None) == "rclpy":
            raise UnavailableError(NOT_INSTALLED) from error
        reason = str(error).splitlines()[0]
        raise UnavailableError(
            f"rclpy cannot be loaded ({reason}); run flockd with the Python of a whole ROS 2"
        ) from error
    return rclpy


def _one_at_a_time() -> Any:
    """A new callback group: callbacks of different groups do not wait for each other."""
    from rclpy.callback_groups import MutuallyExclusiveCallbackGroup  # noqa: PLC0415

    return MutuallyExclusiveCallbackGroup()


def _profile(delivery: Delivery) -> Any:
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: PLC0415

    if delivery is Delivery.SENSOR:
        return QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    kept = DurabilityPolicy.TRANSIENT_LOCAL if delivery is Delivery.STATE else DurabilityPolicy.VOLATILE
    depth = 10 if delivery is Delivery.EVENT else 1
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=kept)


def _type(kind: str) -> Any:
    """The class of `package/msg/Name`."""
    package, _, name = kind.partition("/")
    folder, _, name = name.rpartition("/")
    try:
        return getattr(importlib.import_module(f"{package}.{folder or 'msg'}"), name)
    except ImportError as error:
        raise UnavailableError(f"this ROS 2 has no {package}; install it beside rclpy") from error


def _message(kind: Any, tree: Mapping[str, Any]) -> Any:
    """A message of rclpy."""
    message, types = kind(), kind.get_fields_and_field_types()
    for name, value in tree.items():
        setattr(message, name, _field(types[name], value))
    return message


def _field(kind: str, value: Any) -> Any:
    if isinstance(value, Mapping):
        return _message(_type(kind), value)
    if kind == "octet":
        return bytes([value])
    if isinstance(value, bytes):
        return array("B", value)
    if isinstance(value, np.ndarray) and kind.startswith("sequence"):
        return array(value.dtype.char, value.tobytes())
    if isinstance(value, list) and (element := _ELEMENT.fullmatch(kind)) is not None:
        return [_message(_type(element[1]), one) for one in value]
    return value

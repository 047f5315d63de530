"""A node of somebody else's stack, with nothing of flockd's: says in lines of JSON what it hears, and does as told.

ros_peer.py NAME. It reads lines of JSON from its standard input, each one order:

- `{"do": "listen", "topic": T, "type": "nav_msgs/msg/Odometry", "qos": "sensor" | "state" | "event"}`
- `{"do": "call", "service": S}`: a Trigger
- `{"do": "publish", "topic": T, "type": ..., "fields": {"header.frame_id": "map", "pose.position.x": 1.0}}`
- `{"do": "topics"}`: who publishes what

and writes `{"heard": T, "at": monotonic seconds, "message": {...}}`, `{"answer": S, "at": ..., "found": ...}`. Bytes
are written as hexadecimal digits, long arrays as their length.
"""

from __future__ import annotations

import importlib
import json
import sys
import threading
import time
from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data

QOS = {
    "sensor": qos_profile_sensor_data,
    "state": QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    "event": QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE),
}
TRIGGER = importlib.import_module("std_srvs.srv").Trigger
LONG = 5000
_lock = threading.Lock()
_publishers: dict[str, Any] = {}


def say(**what: Any) -> None:
    with _lock:
        sys.stdout.write(json.dumps(what) + "\n")
        sys.stdout.flush()


def plain(value: Any) -> Any:
    """A message as JSON."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return value[0] if len(value) == 1 else len(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if type(value).__name__ == "array":
        if len(value) > LONG:
            return len(value)
        return bytes(value).hex() if value.typecode == "B" else list(value)
    return value


def kind_of(name: str) -> Any:
    package, folder, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.{folder}"), kind)


def listen(node: Any, topic: str, kind: str, qos: str) -> None:
    def take(message: Any) -> None:
        say(heard=topic, at=time.monotonic(), message=plain(message))

    node.create_subscription(kind_of(kind), topic, take, QOS[qos])


def call(node: Any, service: str) -> None:
    client = node.create_client(TRIGGER, service)
    found = client.wait_for_service(timeout_sec=5.0)
    began = time.monotonic()
    if not found:
        say(answer=service, found=False)
        return
    future = client.call_async(TRIGGER.Request())
    future.add_done_callback(
        lambda done: say(
            answer=service, found=True, took=time.monotonic() - began, ok=done.result().success,
            text=done.result().message,
        )
    )  # fmt: skip


def publish(node: Any, topic: str, kind: str, fields: dict[str, Any]) -> None:
    if topic not in _publishers:
        _publishers[topic] = node.create_publisher(kind_of(kind), topic, 10)
        until = time.monotonic() + 10.0
        while not _publishers[topic].get_subscription_count() and time.monotonic() < until:
            time.sleep(0.01)
    message = kind_of(kind)()
    for name, value in fields.items():
        *path, last = name.split(".")
        setattr(reduce(getattr, path, message), last, value)
    _publishers[topic].publish(message)
    say(published=topic, at=time.monotonic())


def topics(node: Any) -> None:
    names = [topic for topic, _ in node.get_topic_names_and_types()]
    say(topics={name: [one.node_name for one in node.get_publishers_info_by_topic(name)] for name in names})


DO: dict[str, Callable[..., None]] = {"listen": listen, "call": call, "publish": publish, "topics": topics}


def main() -> None:
    rclpy.init()
    node = rclpy.create_node(sys.argv[1])
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    say(ready=True)
    for line in sys.stdin:
        order = json.loads(line)
        do = DO[order.pop("do")]
        if "type" in order:
            order["kind"] = order.pop("type")
        do(node, **order)


if __name__ == "__main__":
    main()

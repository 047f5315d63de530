"""Listens to one camera's topics of ROS 2 and writes what comes to standard output; a process of its own.

ros_child.py TOPIC CAMERA_INFO_TOPIC system|simulator

It needs rclpy, and nothing of flockd. What it writes are messages as those of `gstreamer_child.py`: `imag` and `jpeg`
are an Image and a CompressedImage, an `IMAGE_HEAD` and the data, with their time in nanoseconds of CLOCK_MONOTONIC;
`info` is the `INFO_BODY` of a CameraInfo; `fail` says why there will be no more. It waits for the topic to appear, and
takes it as its publishers offer it: reliably where all do, else by best effort.
"""

from __future__ import annotations

import importlib
import os
import struct
import sys
import threading
import time
from collections import deque
from typing import Any

HEADER = struct.Struct("<4sIqI4x")
IMAGE, COMPRESSED, INFO, ERROR = b"imag", b"jpeg", b"info", b"fail"
NO_TIME = -1
NO_ROS = "there is no rclpy"
IMAGES = {"sensor_msgs/msg/Image": (IMAGE, "Image"), "sensor_msgs/msg/CompressedImage": (COMPRESSED, "CompressedImage")}
IMAGE_HEAD = struct.Struct("<64sIII")
"""The encoding or format; width, height and bytes a line of an Image."""
INFO_BODY = struct.Struct("<II4d")
"""Width, height; fx, fy, cx, cy."""
_LOOK_S = 0.1
_CLOCK_S = 0.5
"""So long one reading of a simulator's clock counts: it may have come late, and then a later one is better."""


def main() -> None:
    """Runs until the other side goes."""
    output = os.dup(1)
    os.dup2(2, 1)  # ROS logs, and this is no place for it
    threading.Thread(target=_await_end, daemon=True).start()
    try:
        topic, info_topic, stamps = sys.argv[1:4]
        listen(topic, info_topic, stamps, output)
    except (ImportError, _TopicError) as error:
        reason = NO_ROS if getattr(error, "name", None) == "rclpy" else str(error)
        send(output, ERROR, reason.splitlines()[0].encode())


class _TopicError(Exception):
    """Why there are no images."""


def _await_end() -> None:
    while os.read(0, 1):
        pass
    os._exit(0)


def listen(topic: str, info_topic: str, stamps: str, output: int) -> None:
    """For ever. Raises ImportError and _TopicError."""
    import rclpy  # noqa: PLC0415 - of ROS 2
    from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: PLC0415

    rclpy.init()
    node = rclpy.create_node(f"flockd_camera_{os.getpid()}")
    kind, name, reliable = _wait_for(node, topic)
    messages = importlib.import_module("sensor_msgs.msg")
    best = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
    offered = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE) if reliable else best
    clock = _Clock()
    if stamps == "simulator":
        kept = importlib.import_module("rosgraph_msgs.msg").Clock
        node.create_subscription(kept, "/clock", lambda now: clock.take(_ns(now.clock)), best)

    def take(message: Any) -> None:
        time_ns = clock.monotonic_ns(_ns(message.header.stamp), simulated=stamps == "simulator")
        send(output, kind, packed(message), time_ns)

    node.create_subscription(getattr(messages, name), topic, take, offered)
    node.create_subscription(messages.CameraInfo, info_topic, lambda info: send(output, INFO, body_of(info)), best)
    rclpy.spin(node)


def packed(message: Any) -> bytes:
    """An Image or CompressedImage as it is written."""
    if hasattr(message, "encoding"):
        head = IMAGE_HEAD.pack(message.encoding.encode(), message.width, message.height, message.step)
    else:
        head = IMAGE_HEAD.pack(message.format.encode(), 0, 0, 0)
    return head + bytes(message.data)


def body_of(info: Any) -> bytes:
    """A CameraInfo as it is written."""
    fx, _, cx, _, fy, cy, *_ = info.k
    return INFO_BODY.pack(info.width, info.height, fx, fy, cx, cy)


def _wait_for(node: Any, topic: str) -> tuple[bytes, str, bool]:
    """What comes there, and whether all who publish it do so reliably."""
    from rclpy.qos import ReliabilityPolicy  # noqa: PLC0415

    while True:
        known = [one for one in node.get_publishers_info_by_topic(topic) if one.topic_type]
        kinds = {one.topic_type for one in known}
        if kinds - IMAGES.keys():
            raise _TopicError(f"is of {sorted(kinds - IMAGES.keys())[0]}")
        if kinds:
            reliable = all(one.qos_profile.reliability == ReliabilityPolicy.RELIABLE for one in known)
            return *IMAGES[sorted(kinds)[0]], reliable
        time.sleep(_LOOK_S)


class _Clock:
    """From stamps to CLOCK_MONOTONIC."""

    def __init__(self) -> None:
        self._readings: deque[tuple[int, int]] = deque()
        """When a simulator's clock came, and by how much that is more than it said."""

    def take(self, stamp_ns: int) -> None:
        now_ns = time.monotonic_ns()
        self._readings.append((now_ns, now_ns - stamp_ns))
        while now_ns - self._readings[0][0] > _CLOCK_S * 1e9:
            self._readings.popleft()

    def monotonic_ns(self, stamp_ns: int, *, simulated: bool) -> int:
        """Of an image's stamp; `NO_TIME` before a simulator's clock came."""
        if not simulated:
            return stamp_ns + time.monotonic_ns() - time.time_ns()
        if not self._readings:
            return NO_TIME
        return stamp_ns + min(behind for _, behind in self._readings)


def _ns(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def send(output: int, kind: bytes, data: bytes, time_ns: int = 0) -> None:
    """One message; ends the process when nobody reads any more."""
    try:
        for part in (HEADER.pack(kind, 0, time_ns, len(data)), data):
            view = memoryview(part)
            while view:
                view = view[os.write(output, view) :]
    except BrokenPipeError:
        os._exit(0)


if __name__ == "__main__":
    main()

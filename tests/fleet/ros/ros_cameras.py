"""A driver of somebody else's: publishes camera images as Image with CameraInfo, with nothing of flockd's.

ros_cameras.py FILE. The file is an npz: `stamps` (seconds, when each set was taken), and for each camera of `names`
`images_NAME` (n, h, w, 3) RGB and `k_NAME` (9,). It waits until each camera has a reader, then publishes each set as
long after the first as it was taken after that, stamped by this computer's clock.
"""

from __future__ import annotations

import importlib
import sys
import time
from array import array
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor

MESSAGES = importlib.import_module("sensor_msgs.msg")


def main() -> None:
    """Publishes all, then waits to be ended."""
    flight = np.load(sys.argv[1])
    names = [str(name) for name in flight["names"]]
    rclpy.init()
    node = rclpy.create_node("driver")
    images = {name: node.create_publisher(MESSAGES.Image, f"/{name}/image_raw", 5) for name in names}
    lenses = {name: node.create_publisher(MESSAGES.CameraInfo, f"/{name}/camera_info", 5) for name in names}
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not all(images[name].get_subscription_count() and lenses[name].get_subscription_count() for name in names):
        executor.spin_once(timeout_sec=0.05)
    time.sleep(0.5)  # the other side learns of it a moment later
    first_ns = time.time_ns()
    for number, stamp_s in enumerate(flight["stamps"]):
        stamp_ns = first_ns + round(1e9 * float(stamp_s - flight["stamps"][0]))
        time.sleep(max(0.0, (stamp_ns - time.time_ns()) / 1e9))
        for name in names:
            publish(images[name], lenses[name], flight[f"images_{name}"][number], flight[f"k_{name}"], stamp_ns)
    sys.stdin.read()


def publish(images: Any, lenses: Any, pixels: Any, k: Any, stamp_ns: int) -> None:
    image, info = MESSAGES.Image(), MESSAGES.CameraInfo()
    for message in (image, info):
        message.header.stamp.sec, message.header.stamp.nanosec = stamp_ns // 10**9, stamp_ns % 10**9
        message.height, message.width = pixels.shape[:2]
    image.encoding, image.step, image.data = "rgb8", 3 * pixels.shape[1], array("B", pixels.tobytes())
    info.k = k
    lenses.publish(info)
    images.publish(image)


if __name__ == "__main__":
    main()

"""A driver of somebody else's: publishes camera images as Image with CameraInfo, with nothing of flockd's.

ros_cameras.py FILE. The file is an npz: `stamps` (seconds, when each set was taken), and for each camera of `names`
`images_NAME` (n, h, w, 3) RGB and `k_NAME` (9,). With `px4`, a quaternion (4,), it is PX4 too: level flight 3 m above
home, 20 times a second, stamped since its start. It waits until each camera has a reader, then publishes each set as
long after the first as it was taken after that, stamped by this computer's clock.
"""

from __future__ import annotations

import importlib
import itertools
import sys
import threading
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
    if "px4" in flight:
        threading.Thread(target=publish_px4, args=(node, flight["px4"]), daemon=True).start()
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


def publish_px4(node: Any, turn: Any) -> None:
    kind = importlib.import_module("px4_msgs.msg").VehicleOdometry
    publisher = node.create_publisher(kind, "/fmu/out/vehicle_odometry", rclpy.qos.qos_profile_sensor_data)
    for tick in itertools.count():
        position = np.array([0.0, 0.0, -3.0], np.float32)
        publisher.publish(kind(timestamp=50_000 * tick, pose_frame=1, position=position, q=turn, velocity_frame=1))
        time.sleep(0.05)


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

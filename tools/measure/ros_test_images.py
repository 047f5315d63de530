"""Publish test images as a camera of ROS 2, for `bench_sources --topic`: different in each frame, stamped as they go.

python -m tools.measure.ros_test_images --topic /bench/image_raw --rate 30 [--jpeg] [--best-effort]
"""

from __future__ import annotations

import argparse
import importlib
import time
from array import array
from typing import Any

import cv2
import numpy as np
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy

KINDS = 8
"""So many images, one after the other: none repeats itself at once."""


def main() -> None:
    """Until Ctrl-C; prints the processor time that an image takes to publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--topic", default="/bench/image_raw")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--rate", type=float, default=30.0, help="images a second")
    parser.add_argument("--jpeg", action="store_true", help="CompressedImage instead of Image")
    parser.add_argument("--best-effort", action="store_true", help="as sensors publish; by default reliably")
    args = parser.parse_args()
    kinds: Any = importlib.import_module("sensor_msgs.msg")
    rclpy.init()
    node = rclpy.create_node("bench_camera")
    offered = ReliabilityPolicy.BEST_EFFORT if args.best_effort else ReliabilityPolicy.RELIABLE
    kind = kinds.CompressedImage if args.jpeg else kinds.Image
    publisher = node.create_publisher(kind, args.topic, QoSProfile(depth=5, reliability=offered))
    messages = [message(kinds, picture(number, args.size), jpeg=args.jpeg) for number in range(KINDS)]
    began_s, number = time.monotonic(), 0
    try:
        while True:
            time.sleep(max(0.0, began_s + number / args.rate - time.monotonic()))
            one, now_ns = messages[number % KINDS], time.time_ns()
            one.header.stamp.sec, one.header.stamp.nanosec = now_ns // 10**9, now_ns % 10**9
            publisher.publish(one)
            number += 1
    except KeyboardInterrupt:
        print(f"{number} images, {1e3 * time.process_time() / number:.2f} ms of processor time each")


def picture(number: int, size: tuple[int, int]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """(h, w, 3): coarse noise, which a JPEG holds in about the bytes of a photograph."""
    rng = np.random.default_rng(number)
    coarse = rng.integers(0, 256, (size[1] // 8, size[0] // 8, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def message(kinds: Any, pixels: np.ndarray[Any, np.dtype[np.uint8]], *, jpeg: bool) -> Any:
    """An Image in RGB, or a CompressedImage."""
    if jpeg:
        return kinds.CompressedImage(format="jpeg", data=array("B", cv2.imencode(".jpg", pixels)[1].tobytes()))
    height, width = pixels.shape[:2]
    return kinds.Image(height=height, width=width, encoding="rgb8", step=3 * width, data=array("B", pixels.tobytes()))


if __name__ == "__main__":
    main()

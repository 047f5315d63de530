"""Plays the sensor of a virtual camera: writes Motion-JPEG to its other end, until it is killed.

python -m tools.checks.device_check.feeder /dev/video20 640 480 25
"""

from __future__ import annotations

import argparse
import fcntl
import itertools
import os
import time

from flockd.onboard.sources.v4l2_kernel import VIDIOC_S_FMT, Format
from tools.checks.device_check import camera_images

_OUTPUT = 2  # V4L2_BUF_TYPE_VIDEO_OUTPUT
_PROGRESSIVE = 1  # V4L2_FIELD_NONE


def main() -> None:
    """Prints a word when the first image is out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("device")
    parser.add_argument("width", type=int)
    parser.add_argument("height", type=int)
    parser.add_argument("rate_hz", type=float)
    arguments = parser.parse_args()
    size = (arguments.width, arguments.height)
    frames = [camera_images.mjpeg(size, number) for number in range(camera_images.COUNT)]
    descriptor = os.open(arguments.device, os.O_RDWR)
    wanted = Format(
        type=_OUTPUT,
        width=size[0],
        height=size[1],
        pixelformat=int.from_bytes(b"MJPG", "little"),
        field=_PROGRESSIVE,
        sizeimage=2 * size[0] * size[1],
    )
    fcntl.ioctl(descriptor, VIDIOC_S_FMT, wanted)
    due_s = time.monotonic()
    for number in itertools.count():
        os.write(descriptor, frames[number % camera_images.COUNT])
        if number == 0:
            print("feeds", flush=True)
        due_s = max(due_s + 1.0 / arguments.rate_hz, time.monotonic())
        time.sleep(max(due_s - time.monotonic(), 0.0))


if __name__ == "__main__":
    main()

"""Plays the sensor of a virtual camera: writes pictures to its other end, until it is ended.

python -m tools.device_check.feeder /dev/video20 mjpeg 640 480 25
"""

from __future__ import annotations

import argparse
import fcntl
import itertools
import os
import time

from flockd.sources.v4l2_device import VIDIOC_S_FMT, Format
from tools.device_check import pictures

_OUTPUT = 2  # V4L2_BUF_TYPE_VIDEO_OUTPUT
_PROGRESSIVE = 1  # V4L2_FIELD_NONE
_FOURCC = {"mjpeg": b"MJPG", "yuyv": b"YUYV"}


def main() -> None:
    """Until it is killed. Prints a word when the first picture is out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("device")
    parser.add_argument("format", choices=sorted(_FOURCC))
    parser.add_argument("width", type=int)
    parser.add_argument("height", type=int)
    parser.add_argument("rate_hz", type=float, help="0: as fast as the device takes them")
    arguments = parser.parse_args()
    size = (arguments.width, arguments.height)
    draw = pictures.mjpeg if arguments.format == "mjpeg" else pictures.yuyv
    frames = [draw(size, number) for number in range(pictures.COUNT)]
    descriptor = os.open(arguments.device, os.O_RDWR)
    _set_format(descriptor, arguments.format, size)
    due_s = time.monotonic()
    for number in itertools.count():
        os.write(descriptor, frames[number % pictures.COUNT])
        if number == 0:
            print("feeds", flush=True)
        if arguments.rate_hz:
            due_s = max(due_s + 1.0 / arguments.rate_hz, time.monotonic())
            time.sleep(max(due_s - time.monotonic(), 0.0))


def _set_format(descriptor: int, name: str, size: pictures.Size) -> None:
    wanted = Format(
        type=_OUTPUT,
        width=size[0],
        height=size[1],
        pixelformat=int.from_bytes(_FOURCC[name], "little"),
        field=_PROGRESSIVE,
        sizeimage=2 * size[0] * size[1],
    )
    fcntl.ioctl(descriptor, VIDIOC_S_FMT, wanted)


if __name__ == "__main__":
    main()

"""The virtual cameras: one of `vivid`, and one of `v4l2loopback` whose sensor is this module as a process.

python -m tools.checks.device_check.cameras 640 480 25
"""

from __future__ import annotations

import fcntl
import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from flockd.onboard.sources.v4l2_device import control_name
from flockd.onboard.sources.v4l2_kernel import (
    VIDIOC_QUERYCTRL,
    VIDIOC_S_CTRL,
    VIDIOC_S_FMT,
    Control,
    Format,
    QueryControl,
)
from tools.checks.device_check.findings import run

WEBCAM = "/dev/video10"
"""A camera of vivid: shows its own pattern, in sizes and rates as USB cameras have them, and breaks in every way it
can."""
LOOPBACK = "/dev/video20"
COUNT = 16
"""Images of the loopback's; then they begin again. No two that follow each other are the same."""
Size = tuple[int, int]
"""Width, height."""
_NEXT = 0x80000000  # V4L2_CTRL_FLAG_NEXT_CTRL
_OUTPUT, _PROGRESSIVE = 2, 1  # V4L2_BUF_TYPE_VIDEO_OUTPUT, V4L2_FIELD_NONE
_WHITE, _COUNTERS = 6, 1
"""A test pattern in which the networks see nothing: in the coloured bars they see drones."""
_SKY, _GRASS = (215, 190, 170), (80, 130)
"""The colour, blue first; from how bright to how bright."""
_PASSING_PX = 4


def load() -> None:
    """Loads both drivers, unless they are."""
    if Path(WEBCAM).exists():
        return
    run("modprobe", "vivid", "n_devs=1", "node_types=0x1", "vid_cap_nr=10", "num_inputs=1", "input_types=0")
    run("modprobe", "v4l2loopback", "devices=1", "video_nr=20", "card_label=front")
    run("udevadm", "settle")
    control("timestamp_source")  # stamped when the image begins; else the stamps lie in the future
    control("test_pattern", _WHITE)
    control("osd_text_mode", _COUNTERS)  # so that no two images are the same


def control(name: str, value: int = 1) -> float:
    """Sets a control of vivid's, or presses it if it is a button; just before when, on the monotonic clock."""
    descriptor = os.open(WEBCAM, os.O_RDWR)
    try:
        query = QueryControl(id=_NEXT)
        while True:
            fcntl.ioctl(descriptor, VIDIOC_QUERYCTRL, query)  # after the last: OSError
            if control_name(query.name) == name:
                break
            query = QueryControl(id=query.id | _NEXT)
        now_s = time.monotonic()
        fcntl.ioctl(descriptor, VIDIOC_S_CTRL, Control(id=query.id, value=value))
    finally:
        os.close(descriptor)
    return now_s


def image(size: Size, number: int) -> bytes:
    """A JPEG that the loopback camera shows: sky above grass that passes by.

    Nothing resembles a drone: to range one takes an emulated processor long.
    """
    width, height = size
    wide, high = width + _PASSING_PX * COUNT, height - height // 2
    blades = np.random.default_rng(0).integers(*_GRASS, (high // 2, wide // 2, 3), dtype=np.uint8)
    scene = np.full((height, width, 3), _SKY, np.uint8)
    scene[height // 2 :] = cv2.resize(blades, (wide, high))[:, _PASSING_PX * number :][:, :width]
    return cv2.imencode(".jpg", scene, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


class Feeder:
    """The process behind the loopback camera."""

    def __init__(self, size: Size, rate_hz: float) -> None:
        """Begins with its first image."""
        command = [sys.executable, "-m", __name__, *map(str, size), str(rate_hz)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE)
        assert self.process.stdout is not None
        if not self.process.stdout.read(1):
            raise RuntimeError(f"{' '.join(command)}: ended at once")

    def fall_silent(self) -> float:
        """Stops its images; since when, on the monotonic clock."""
        self.process.send_signal(signal.SIGSTOP)
        return time.monotonic()

    def go_on(self) -> float:
        """Sends images again; since when."""
        self.process.send_signal(signal.SIGCONT)
        return time.monotonic()

    def close(self) -> None:
        """Ends it."""
        self.process.kill()
        self.process.wait()


def feed(size: Size, rate_hz: float) -> None:
    """Plays the sensor until it is killed; prints a word when the first image is out."""
    wanted = Format(
        type=_OUTPUT, width=size[0], height=size[1], pixelformat=int.from_bytes(b"MJPG", "little"), field=_PROGRESSIVE,
        sizeimage=2 * size[0] * size[1],
    )  # fmt: skip
    frames = [image(size, number) for number in range(COUNT)]
    descriptor = os.open(LOOPBACK, os.O_RDWR)
    fcntl.ioctl(descriptor, VIDIOC_S_FMT, wanted)
    due_s = time.monotonic()
    for number in itertools.count():
        os.write(descriptor, frames[number % COUNT])
        if number == 0:
            print("feeds", flush=True)
        due_s = max(due_s + 1.0 / rate_hz, time.monotonic())
        time.sleep(max(due_s - time.monotonic(), 0.0))


if __name__ == "__main__":
    _, wide_px, high_px, hz = sys.argv
    feed((int(wide_px), int(high_px)), float(hz))

"""The virtual cameras: two of `vivid`, and one of `v4l2loopback` whose sensor is a process of ours."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from flockd.onboard.sources.v4l2_device import control_name
from flockd.onboard.sources.v4l2_kernel import VIDIOC_QUERYCTRL, VIDIOC_S_CTRL, Control, QueryControl

WEBCAM = "/dev/video10"
"""A camera of vivid: shows its own pattern, in sizes and rates as USB cameras have them, and breaks in every way it
can."""
CABLE_OUT, CABLE = "/dev/video11", "/dev/video12"
"""An HDMI output of vivid, and the camera at the other end of its cable."""
LOOPBACK = "/dev/video20"
"""A camera of v4l2loopback with Motion-JPEG."""
_NEXT = 0x80000000  # V4L2_CTRL_FLAG_NEXT_CTRL
_WHITE = 6
"""A test pattern in which the networks see nothing: in the coloured bars they see drones."""
_COUNTERS, _NOTHING = 1, 2
_FIRST_OUTPUT = 2


def load() -> None:
    """Loads both drivers, unless they are."""
    if Path(WEBCAM).exists():
        return
    devices = ["n_devs=2", "node_types=0x1,0x101", "vid_cap_nr=10,12", "vid_out_nr=-1,11"]
    ends = ["num_inputs=1,1", "input_types=0,3", "num_outputs=1,1", "output_types=1,1"]  # a webcam; HDMI to HDMI
    run("modprobe", "vivid", *devices, *ends)
    run("modprobe", "v4l2loopback", "devices=1", "video_nr=20", "card_label=front")
    run("udevadm", "settle")
    for device in (WEBCAM, CABLE):
        control(device, "timestamp_source")  # stamped when the image begins; else the stamps lie in the future
    for device in (CABLE_OUT, CABLE):
        run("v4l2-ctl", "-d", device, "--set-dv-bt-timings", f"index={_vga(device)}")
    control(WEBCAM, "test_pattern", _WHITE)
    control(WEBCAM, "osd_text_mode", _COUNTERS)  # so that no two images are the same
    _plug_in()
    control(CABLE, "osd_text_mode", _NOTHING)  # written over the images


def _plug_in() -> None:
    """Connects the cable: since Linux 6.11 each input says to which output it leads, after itself and none."""
    with _opened(CABLE) as descriptor:
        names = _controls(descriptor)
    to_output = next((name for name in names if name.endswith("_is_connected_to")), None)
    if to_output is None:
        control(CABLE, "loop_video")
    else:
        control(CABLE, to_output, _FIRST_OUTPUT)


def control(device: str, name: str, value: int = 1) -> float:
    """Sets a control, or presses it if it is a button; just before when, on the monotonic clock."""
    with _opened(device) as descriptor:
        wanted = Control(id=_controls(descriptor)[name], value=value)
        now_s = time.monotonic()
        fcntl.ioctl(descriptor, VIDIOC_S_CTRL, wanted)
    return now_s


@contextmanager
def _opened(device: str) -> Iterator[int]:
    descriptor = os.open(device, os.O_RDWR)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def run(*command: str) -> str:
    """What a command prints. Raises RuntimeError with what it complained of."""
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RuntimeError(f"{' '.join(command)}: {result.stderr.strip() or result.stdout.strip()}")
    return result.stdout


class Feeder:
    """The process behind a camera."""

    def __init__(self, *command: str) -> None:
        """Begins once the process has said something, which it does with its first image."""
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        assert self._process.stdout is not None
        if not self._process.stdout.read(1):
            raise RuntimeError(f"{' '.join(command)}: ended at once")

    def fall_silent(self) -> float:
        """Stops its images; since when, on the monotonic clock."""
        os.kill(self._process.pid, signal.SIGSTOP)
        return time.monotonic()

    def go_on(self) -> float:
        """Sends images again; since when."""
        os.kill(self._process.pid, signal.SIGCONT)
        return time.monotonic()

    def close(self) -> None:
        """Ends it."""
        self._process.kill()
        self._process.wait()


def loopback(size: tuple[int, int], rate_hz: float) -> Feeder:
    """Feeds the loopback camera with Motion-JPEG."""
    module = [sys.executable, "-m", "tools.checks.device_check.feeder"]
    return Feeder(*module, LOOPBACK, *map(str, size), str(rate_hz))


def cable(images: Sequence[bytes]) -> Feeder:
    """Feeds the HDMI output with frames, over and over."""
    with tempfile.NamedTemporaryFile(delete=False) as file:
        file.write(b"".join(images))
    return Feeder("v4l2-ctl", "-d", CABLE_OUT, "--stream-out-mmap", f"--stream-from={file.name}", "--stream-loop")


@contextmanager
def feeding(feeder: Feeder) -> Iterator[Feeder]:
    """Until the end of the block."""
    try:
        yield feeder
    finally:
        feeder.close()


def _controls(descriptor: int) -> dict[str, int]:
    """The number of each, by its name."""
    found: dict[str, int] = {}
    query = QueryControl(id=_NEXT)
    while True:
        try:
            fcntl.ioctl(descriptor, VIDIOC_QUERYCTRL, query)
        except OSError:
            return found  # that was the last
        found[control_name(query.name)] = query.id
        query = QueryControl(id=query.id | _NEXT)


def _vga(device: str) -> int:
    """Which of the device's timings is 640x480 at 60 Hz."""
    index, width, height = -1, "", ""
    for line in run("v4l2-ctl", "-d", device, "--list-dv-timings").splitlines():
        key, _, value = (part.strip() for part in line.partition(":"))
        match key:
            case "Index":
                index = int(value)
            case "Active width":
                width = value
            case "Active height":
                height = value
            case "Pixelclock" if (width, height) == ("640", "480") and "59.94" in value:
                return index
    raise RuntimeError(f"{device} has no timings of 640x480 at 59.94 Hz")

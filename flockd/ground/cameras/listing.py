"""Which cameras are plugged in: those of the kernel, and those that GStreamer's device monitor finds."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from flockd.ground.cameras.found import FoundCamera, Mode
from flockd.ground.cameras.gstreamer_listing import MONITOR, cameras_of_monitor
from flockd.ground.cameras.v4l2_listing import SENSOR_ONLY, read_camera
from flockd.onboard.sources.v4l2_kernel import Kernel

BY_PATH = Path("/dev/v4l/by-path")
"""udev's links by the socket that a camera is plugged into: they stay the same whatever is plugged in elsewhere."""
RUN_S = 20.0
_ARGUS = "nvarguscamerasrc"
_ARGUS_MODES = tuple(Mode("NV12", size, (30.0,)) for size in ((640, 480), (1280, 720), (1920, 1080)))
"""It scales to whatever it is asked for."""


def run_program(command: Sequence[str]) -> str | None:
    """What a program prints; None where it is not installed, fails or takes too long."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=RUN_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


@dataclass(frozen=True)
class Computer:
    """Where cameras are looked for."""

    kernel: Kernel = field(default_factory=Kernel)
    nodes: Path = Path("/sys/class/video4linux")
    links: Path = BY_PATH
    run: Callable[[Sequence[str]], str | None] = run_program


def list_cameras(computer: Computer) -> list[FoundCamera]:
    """All of them, in a stable order; one that cannot be used says why."""
    found = list(_of_kernel(computer))
    monitored = cameras_of_monitor(computer.run(MONITOR) or "")
    if any(camera.fault == SENSOR_ONLY for camera in found) and computer.run(("gst-inspect-1.0", "--exists", _ARGUS)):
        found = list(_by_argus(found))
    elif monitored:  # they are the sensors among the kernel's devices
        found = [camera for camera in found if camera.fault != SENSOR_ONLY]
    return found + monitored


def _of_kernel(computer: Computer) -> Iterator[FoundCamera]:
    links = _stable_paths(computer.links)
    names = sorted((file.name for file in computer.nodes.glob("video*")), key=lambda name: (len(name), name))
    for name in names:
        camera = read_camera(computer.kernel, f"/dev/{name}", links.get(name, f"/dev/{name}"))
        if camera is not None:
            yield camera


def _stable_paths(folder: Path) -> dict[str, str]:
    """By the name of the node; of several the shortest, as udev has more than one for a USB 2 socket."""
    links: dict[str, str] = {}
    for link in sorted(folder.glob("*"), key=lambda link: (len(link.name), link.name)):
        if link.is_symlink():
            links.setdefault(link.readlink().name, str(BY_PATH / link.name))
    return links


def _by_argus(found: Sequence[FoundCamera]) -> Iterator[FoundCamera]:
    """On a Jetson the sensors of the CSI ports are cameras of NVIDIA's, numbered in the kernel's order."""
    number = 0
    for camera in found:
        if camera.fault == SENSOR_ONLY:
            element = f"{_ARGUS} sensor-id={number}"
            yield replace(camera, device="", element=element, modes=_ARGUS_MODES, fault=None)
            number += 1
        else:
            yield camera

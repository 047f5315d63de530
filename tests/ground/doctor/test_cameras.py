"""Cameras as they come: steady, slow, dark, gone, stuck; and their calibrations. The kernel is a fake."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.core.config import DroneConfig, load_drone
from flockd.core.config.rig import CameraConfig, IntrinsicsConfig, RigConfig
from flockd.core.config.source import (
    CameraDeviceParameters,
    ControlParameters,
    SharedMemoryParameters,
    SourceParameters,
)
from flockd.core.data import data_path
from flockd.core.messages import Frame
from flockd.ground.doctor import Finding, Level
from flockd.ground.doctor.camera_checks import check_cameras, coverage, lens_problems
from flockd.onboard.sources import FramePublisher
from flockd.onboard.sources.device_source import Devices
from flockd.sim.sitl.processes import free_endpoint
from tests import make
from tests.ground.filming import JPEGS, RATE_HZ, filming
from tests.onboard.sources.camera_images import SIZE, jpeg, scene
from tests.onboard.sources.fake_kernel import FLAG_CLOCK_UNKNOWN, FLAG_ERROR, FakeCamera, FakeKernel

SECONDS = 0.7
BLACK = [jpeg(np.full((SIZE[1], SIZE[0], 3), 4, np.uint8) + scene(n) // 32) for n in range(4)]
BY_HAND = (
    ControlParameters(name="auto_exposure", value=1),
    ControlParameters(name="exposure_time_absolute", value=50),
)


def _config(*names: str, controls: Sequence[ControlParameters] = BY_HAND) -> DroneConfig:
    rig = [make.camera(name, SIZE, 300.0) for name in names]
    devices = tuple(
        CameraDeviceParameters(name=name, device=f"/dev/{name}", rate_hz=RATE_HZ, controls=tuple(controls))
        for name in names
    )
    return make.drone(*rig, source=SourceParameters(kind="v4l2", cameras=devices))


def _examined(
    config: DroneConfig, devices: FakeKernel | Devices | None = None, start_s: float = 60.0
) -> dict[str, list[Finding]]:
    found: dict[str, list[Finding]] = {}
    used = Devices(devices) if isinstance(devices, FakeKernel) else devices
    for finding in check_cameras(config, SECONDS, used, start_s):
        found.setdefault(finding.about, []).append(finding)
    return found


def test_two_cameras_that_run_as_they_should() -> None:
    kernel = FakeKernel(front=FakeCamera(), back=FakeCamera())
    with filming(kernel, "front", "back"):
        found = _examined(_config("front", "back"), kernel)
    for name in ("front", "back"):
        (finding,) = found[f"camera {name}"]
        assert finding.level is Level.PASS, finding
        assert "30.0 of 30 images a second, jitter 0.0 ms, no gaps, 2 controls accepted" in finding.measured
        assert "calibration fits 640x480, 94 degrees" in finding.measured
    assert found["coverage"][0].level is Level.WARNING, "both look forward"
    assert not kernel.open_files, "all are given back"
    with filming(kernel, "front"):
        found = _examined(_config("front", controls=()), kernel)
    _problem(found, Level.WARNING, "its exposure is not configured")
    cameras, camera, _ = check_cameras(_config("front").model_copy(update={"source": None}), SECONDS)
    assert (cameras.level, camera.level) == (Level.WARNING, Level.PASS), "without a source it can be simulated"


def test_two_cameras_in_one_image_are_judged_each_by_itself() -> None:
    """Side by side in 1280 x 480; the board that is not there is a fault of both."""
    config = _config("front", "back")
    assert config.source is not None
    halves = [
        one.model_copy(update={"device": "/dev/board", "crop": (640 * number, 0, 640, 480)})
        for number, one in enumerate(config.source.cameras)
    ]
    config = config.model_copy(update={"source": config.source.model_copy(update={"cameras": tuple(halves)})})
    kernel = FakeKernel(board=FakeCamera(formats=((1280, 480, b"MJPG"),)))
    both = [jpeg(np.concatenate([scene(number), scene(number + 10)], axis=1)) for number in range(8)]
    with filming(kernel, "board", pictures=both):
        found = _examined(config, kernel)
    for name, left in (("front", 0), ("back", 640)):
        (finding,) = found[f"camera {name}"]
        assert finding.level is Level.PASS, finding
        assert f"no gaps, 2 controls accepted, cut at {left}, 0 from images of /dev/board" in finding.measured
    found = _examined(config, FakeKernel())
    for name in ("front", "back"):
        _problem(found, Level.FAILURE, "/dev/board is not there", f"camera {name}")


def _problem(found: dict[str, list[Finding]], level: Level, told: str, about: str = "camera front") -> Finding:
    (problem,) = found[about]
    assert problem.level is level, problem
    assert told in problem.measured, problem
    assert problem.fix
    return problem


def _late(off_s: float) -> Callable[[int], float]:
    """Every fourth is late: two of four intervals are off by as much."""
    return lambda number: number / RATE_HZ + (off_s if number % 4 == 3 else 0.0)


@pytest.mark.parametrize(
    ("film", "level", "told"),
    [
        ({"beats_s": lambda number: number / 15.0}, Level.FAILURE, "15.0 images a second instead of 30"),
        ({"beats_s": lambda number: number / 27.0}, Level.WARNING, "27.0 images a second instead of 30"),
        ({"beats_s": _late(0.012)}, Level.WARNING, "images come unevenly"),
        ({"beats_s": _late(0.03)}, Level.FAILURE, "images come unevenly"),
        ({"lost": lambda number: int(number % 10 == 9)}, Level.WARNING, " lost ("),
        ({"lost": lambda number: 1}, Level.FAILURE, " lost ("),
        ({"flags": lambda n: 0x2000 | (FLAG_ERROR if n % 2 else 0)}, Level.FAILURE, "damaged, as the driver reports"),
        ({"pictures": JPEGS[:1]}, Level.FAILURE, "frozen"),
        ({"pictures": [*JPEGS[:3], JPEGS[3][:-100]]}, Level.FAILURE, "corrupt"),
        ({"pictures": BLACK}, Level.WARNING, "the image is too dark"),
    ],
    ids=["half", "slower", "late", "very late", "some lost", "many lost", "flagged", "frozen", "corrupt", "cap"],
)
def test_a_camera_that_does_not_run_as_it_should(film: dict[str, Any], level: Level, told: str) -> None:
    kernel = FakeKernel(front=FakeCamera())
    with filming(kernel, "front", **film):
        problem = _examined(_config("front"), kernel)["camera front"][0]
    assert problem.level is level, problem
    assert told in problem.measured, problem
    assert problem.fix


def test_time_stamps_of_another_clock_are_no_image_at_all() -> None:
    """Some drivers do not name their clock: what counts is whether the stamps are of now."""
    kernel = FakeKernel(front=FakeCamera())
    with filming(kernel, "front", flags=lambda number: FLAG_CLOCK_UNKNOWN):
        (finding,) = _examined(_config("front"), kernel)["camera front"]
    assert finding.level is Level.PASS, finding
    with filming(kernel, "front", old_s=2.0):
        found = _examined(_config("front"), kernel)
    _problem(found, Level.FAILURE, "gave no usable image for 3 s (the last was refused: time stamp)")


def test_cameras_that_do_not_open_are_reported_one_by_one() -> None:
    taken, small, busless = FakeCamera(), FakeCamera(formats=((320, 240, b"MJPG"),)), FakeCamera(rates=(10,))
    kernel = FakeKernel(taken=taken, small=small, busless=busless, controlled=FakeCamera())
    taken.owner = 1
    config = _config("gone", "taken", "small", "busless")
    found = _examined(config, kernel)
    _problem(found, Level.FAILURE, "/dev/gone is not there", "camera gone")
    _problem(found, Level.FAILURE, "/dev/taken is in use by another program", "camera taken")
    _problem(found, Level.FAILURE, "offers 320x240 MJPG instead of 640x480", "camera small")
    problem = _problem(found, Level.FAILURE, "runs at 10 instead of 30 images a second", "camera busless")
    assert problem.fix == "write rate_hz: 10"
    refused = _config("controlled", controls=(ControlParameters(name="exposure_time_absolute", value=9999),))
    _problem(
        _examined(refused, kernel), Level.FAILURE, "takes exposure_time_absolute from 1 to 5000", "camera controlled"
    )


def test_a_driver_that_hangs_is_reported_and_the_other_camera_is_seen() -> None:
    ended = threading.Event()

    class Stuck(FakeKernel):
        def open(self, path: str) -> int:
            if path == "/dev/back":
                ended.wait()
            return super().open(path)

    kernel = Stuck(front=FakeCamera(), back=FakeCamera())
    with filming(kernel, "front"):
        found = _examined(_config("front", "back"), kernel, start_s=5.0)
    ended.set()
    assert found["camera front"][0].level is Level.PASS
    _problem(found, Level.FAILURE, "its driver does not respond", "camera back")


def test_a_pipeline_is_watched_as_a_device_is() -> None:
    fake = (sys.executable, "-IS", str(Path(__file__).parents[2] / "onboard" / "sources" / "fake_child.py"))
    names = {"front": "caps:64x48 500 stall", "back": "fail:has_failed_(no_such_sensor)"}
    cameras = tuple(CameraDeviceParameters(name=n, pipeline=text, rate_hz=40.0) for n, text in names.items())
    source = SourceParameters(kind="gstreamer", cameras=cameras)
    config = make.drone(*(make.camera(name) for name in names), source=source)
    found = _examined(config, Devices(command=fake), 10.0)
    told = " ".join(finding.measured for finding in found["camera front"])
    assert "images a second" in told
    assert "exposure is not configured" not in told, "a pipeline sets its own"
    _problem(found, Level.FAILURE, "its pipeline has failed (no such sensor)", "camera back")


def test_frames_of_another_program() -> None:
    """Those that fit, those of another size, and none at all."""
    endpoint, ended, width = free_endpoint(), threading.Event(), 64
    where = SharedMemoryParameters(drone="tiny", connect=(endpoint,), rate_hz=20.0)
    config = make.drone(source=SourceParameters(kind="shared_memory", shared_memory=where))
    publisher = FramePublisher(listen=[endpoint])

    def publish() -> None:
        rng, number, began_s = np.random.default_rng(0), 0, time.monotonic()
        while not ended.wait(0.05):
            number += 1
            image = rng.integers(0, 256, (48, width, 3), dtype=np.uint8)
            publisher.publish("tiny", Frame("front", image, began_s + 0.05 * number, number))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        found = _examined(config)["camera front"]
        assert "20.0 of 20 images a second, jitter 0.0 ms, no gaps" in found[0].measured
        width = 32
        _problem(_examined(config), Level.FAILURE, "frames are 32x48, but the rig has 64x48")
    finally:
        ended.set()
        thread.join()
        publisher.close()
    _problem(_examined(config, start_s=0.3), Level.FAILURE, f"no frame of tiny/front came from {endpoint} within 0.3 s")


QUADROTOR = load_drone(data_path("config") / "quadrotor.yaml").rig
SIMULATOR = load_drone(data_path("config") / "simulator.yaml").rig


def _camera(**lens: object) -> CameraConfig:
    values = {"fx": 320.0, "fy": 320.0, "cx": 320.0, "cy": 240.0, **lens}
    return CameraConfig(name="front", size_px=(640, 480), intrinsics=IntrinsicsConfig.model_validate(values))


@pytest.mark.parametrize("camera", [*QUADROTOR.cameras, *SIMULATOR.cameras], ids=lambda camera: camera.name)
def test_the_shipped_calibrations_can_be_true(camera: CameraConfig) -> None:
    assert not list(lens_problems(camera))


@pytest.mark.parametrize(
    ("lens", "told", "fix"),
    [
        ({"cx": 385.0}, "principal point 385, 240 is 10%", "calibrate this camera"),
        ({"fx": 337.0}, "fx 337 and fy 320 differ by 5%", "calibrate this camera"),
        ({"fx": 1100.0, "fy": 1100.0}, "32 degrees of view show few neighbours", "calibrate this camera"),
        # Equidistant, half a turn wide: of the width 63 of 90 degrees are seen, and all of the height.
        ({"model": "wide_angle", "fx": 203.7, "fy": 203.7}, "of the image shows what is more than 63", "narrow the"),
    ],
)
def test_an_unlikely_calibration_or_one_beyond_the_networks_is_reported(
    lens: dict[str, object], told: str, fix: str
) -> None:
    (problem,) = lens_problems(_camera(**lens))
    assert (problem.level, problem.about) == (Level.WARNING, "camera front")
    assert told in problem.measured
    assert problem.fix.startswith(fix)


def test_four_cameras_see_all_around_and_three_do_not() -> None:
    """And how far off the horizon: between two pinholes, 45 degrees off each axis, an edge at 320 of 222 px is at
    atan(320 / 222 * cos 45)."""
    assert coverage(QUADROTOR).level is Level.PASS
    assert "all around to 45 degrees off it" in coverage(SIMULATOR).measured
    three = RigConfig(cameras=tuple(camera for camera in QUADROTOR.cameras if camera.name != "back"))
    found = coverage(three)
    assert found.level is Level.WARNING
    # The right camera ends 48.75 degrees behind 90, the left one begins 48.75 before 270.
    assert "from 139 to 221 degrees" in found.measured
    ahead_is_blind = RigConfig(cameras=tuple(camera for camera in QUADROTOR.cameras if camera.name != "front"))
    assert "from 319 to 41 degrees" in coverage(ahead_is_blind).measured
    front = SIMULATOR.cameras[0]
    down = front.model_copy(update={"extrinsics": front.extrinsics.model_copy(update={"pitch_deg": -90.0})})
    assert coverage(RigConfig(cameras=(down,))).level is Level.FAILURE

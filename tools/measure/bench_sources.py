"""Measure what it takes to get camera frames into the pilot: decoding, putting sets together, shared memory, devices.

python -m tools.measure.bench_sources [--size 640 480] [--cameras 4] [--json]
python -m tools.measure.bench_sources --device /dev/video0 --pipeline "v4l2src device=/dev/video2"

The second form compares cameras instead: rate, jitter, age and what is lost of each, with the processor's time an image
takes. `python -m tools.checks.check_pipelines` tries what can go wrong with pipelines, `tools/checks/check_device.py`
with both.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from multiprocessing.synchronize import Event
from pathlib import Path

import cv2
import numpy as np

from flockd.core.config.drone import DroneConfig
from flockd.core.config.rig import CameraConfig, IntrinsicsConfig, RigConfig
from flockd.core.config.source import CameraDeviceParameters, SharedMemoryParameters, SourceParameters
from flockd.core.messages import Frame, UInt8Array
from flockd.ground.cameras.watching import Watched, opener
from flockd.onboard.sources import FramePublisher
from flockd.onboard.sources.assembler import Assembler
from flockd.onboard.sources.devices import CameraDevice, CapturedBuffer
from flockd.onboard.sources.frames import RawFrame
from flockd.onboard.sources.image_formats import MjpegFormat, RgbFormat, YuyvFormat
from flockd.onboard.sources.shared_memory import SharedMemorySource
from flockd.onboard.sources.v4l2_kernel import LinuxKernel

ENDPOINT = "tcp/127.0.0.1:7458"
ROUNDS = 100
PERIOD_S = 0.05
IMAGES, WARM_UP = 200, 10
Size = tuple[int, int]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--threads", type=int, default=1, help="that OpenCV may use")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--device", action="append", default=[], help="of a V4L2 camera; may be repeated")
    parser.add_argument("--pipeline", action="append", default=[], help="of GStreamer; may be repeated")
    parser.add_argument("--rate", type=float, default=30.0, help="of the cameras, images a second")
    parser.add_argument("--format", choices=("mjpeg", "yuyv"), default="mjpeg", help="of the V4L2 cameras")
    arguments = parser.parse_args()
    cv2.setNumThreads(arguments.threads)
    size: Size = (arguments.size[0], arguments.size[1])
    if arguments.device or arguments.pipeline:
        compare_cameras(arguments, size)
        return
    times_ms = measure_decoding(size) | measure_sets(arguments.cameras) | measure_shared_memory(size, arguments.cameras)
    if arguments.json:
        print(json.dumps(times_ms, indent=1))
        return
    print(f"{size[0]}x{size[1]}, {arguments.cameras} cameras, {ROUNDS} rounds{'p50 ms':>32s}{'p95 ms':>9s}")
    for name, (median, high) in times_ms.items():
        print(f"{name:58s}{median:9.3f}{high:9.3f}")


def compare_cameras(arguments: argparse.Namespace, size: Size) -> None:
    """Prints a row a camera, one after the other."""
    cameras = [
        *({"device": device, "pixel_format": arguments.format} for device in arguments.device),
        *({"pipeline": pipeline} for pipeline in arguments.pipeline),
    ]
    rows = []
    for camera in cameras:
        parameters = CameraDeviceParameters.model_validate({"name": "bench", "rate_hz": arguments.rate, **camera})
        with opener(LinuxKernel())(parameters, size) as device:
            rows.append({"camera": parameters.place, **measure_camera(device)})
    if arguments.json:
        print(json.dumps(rows, indent=1))
        return
    print(f"{size[0]}x{size[1]}, {IMAGES} images   rate Hz  jitter ms  age ms p50/p95  lost  processor ms an image")
    for row in rows:
        print(
            f"{row['rate_hz']:33.2f}{row['jitter_ms']:11.2f}{row['age_p50_ms']:10.1f}/{row['age_p95_ms']:<6.1f}"
            f"{row['lost']:5.0f}{row['processor_ms']:14.2f}   {row['camera']}"
        )


def measure_camera(device: CameraDevice) -> dict[str, float]:
    """Of the images of one camera, after the first ones, which waited for the start."""
    watched, ages_ms, began_s = Watched(), [], 0.0
    last: CapturedBuffer | None = None
    for number in range(WARM_UP + IMAGES):
        captured = device.read(device.start_s)
        if captured is None:
            sys.exit(f"no image came within {device.start_s:g} s")
        if number >= WARM_UP and last is not None:
            watched.stamps_s.append(captured.time_s)
            watched.lost += captured.sequence - last.sequence - 1
            ages_ms.append(1e3 * (time.monotonic() - captured.time_s))
        else:
            began_s = _processor_s()
        last = captured
    spent_s = _processor_s() - began_s
    p50_ms, p95_ms = _percentiles(ages_ms)
    return {
        **{"rate_hz": watched.rate_hz, "jitter_ms": 1e3 * watched.jitter_s(), "age_p50_ms": p50_ms},
        **{"age_p95_ms": p95_ms, "lost": watched.lost, "processor_ms": 1e3 * spent_s / IMAGES},
    }


def _processor_s() -> float:
    """Of this process and of those it started that still run."""
    ticks = 0.0
    for task in Path("/proc/self/task").iterdir():
        for pid in (task / "children").read_text(encoding="ascii").split():
            fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
            ticks += float(fields[11]) + float(fields[12])
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


def measure_decoding(size: Size) -> dict[str, tuple[float, float]]:
    """From a camera's bytes to RGB, one image."""
    image = _scene(size)
    ok, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])
    assert ok
    mjpeg, jpeg = MjpegFormat(size), encoded.tobytes()
    yuyv, pairs = YuyvFormat(size, 2 * size[0]), image[..., :2].tobytes()
    rgb, plain = RgbFormat(size), image.tobytes()
    return {
        f"MJPEG check before decoding ({len(jpeg) // 1000} kB)": _timed(lambda: mjpeg.check(jpeg)),
        "MJPEG to RGB, with all checks": _timed(lambda: mjpeg.decode(jpeg)),
        "YUYV to RGB, with all checks": _timed(lambda: yuyv.decode(pairs)),
        "RGB as it is": _timed(lambda: rgb.decode(plain)),
    }


def measure_sets(cameras: int) -> dict[str, tuple[float, float]]:
    """One frame of each camera in, one set out, without decoding."""
    names = [f"camera-{index}" for index in range(cameras)]
    assembler = Assembler(names, SourceParameters(kind="shared_memory"))
    decode = RgbFormat((1, 1)).decode
    payloads = [bytes([number % 256]) * 40_000 for number in range(7)]

    def one_set(number: int) -> None:
        for name in names:
            assembler.offer(RawFrame(name, payloads[number % 7], decode, 0.1 * number, number), 0.1 * number)
        assert assembler.take(0.1 * number) is not None

    numbers = iter(range(1, 10 * ROUNDS))
    return {"one set out of one frame a camera, not decoded": _timed(lambda: one_set(next(numbers)))}


def measure_shared_memory(size: Size, cameras: int) -> dict[str, tuple[float, float]]:
    """A set of frames from another process: to publish it, and until the pilot has it."""
    names = [f"camera-{index}" for index in range(cameras)]
    lens = IntrinsicsConfig(fx=300.0, fy=300.0, cx=320.0, cy=240.0)
    rig = RigConfig(cameras=tuple(CameraConfig(name=name, size_px=size, intrinsics=lens) for name in names))
    where = SharedMemoryParameters(drone="bench", connect=(ENDPOINT,))
    parameters = SourceParameters(kind="shared_memory", shared_memory=where)
    source = SharedMemorySource(DroneConfig(rig=rig, source=parameters), parameters)
    context = multiprocessing.get_context("spawn")
    stopping, publishing_ms = context.Event(), context.SimpleQueue()
    simulator = context.Process(target=_publish, args=(size, names, stopping, publishing_ms), daemon=True)
    simulator.start()
    source.start()
    ages_ms: list[float] = []
    try:
        while len(ages_ms) < ROUNDS:
            frames = source.newest(20.0)
            if frames is None:
                sys.exit("no frames came; is the port of the benchmark in use?")
            if len(frames.frames) == cameras:
                ages_ms.append((time.monotonic() - frames.time_s) * 1e3)
    finally:
        stopping.set()
        source.stop()
    for note in source.notes():
        print(f"note: {note}", file=sys.stderr)
    return {
        f"publishing {cameras} frames to another process": publishing_ms.get(),
        f"from the first of {cameras} frames published to the set received": _percentiles(ages_ms),
    }


def _publish(
    size: Size, names: list[str], stopping: Event, times_ms: multiprocessing.SimpleQueue[tuple[float, float]]
) -> None:
    """In the other process: a set each period, stamped when it is sent."""
    images = [_scene(size, seed) for seed in range(8)]
    spent_ms = []
    with FramePublisher(listen=[ENDPOINT]) as publisher:
        number = 0
        while not stopping.wait(PERIOD_S):
            began_s = time.monotonic()
            for index, name in enumerate(names):
                publisher.publish("bench", Frame(name, images[(number + index) % len(images)], began_s, number))
            spent_ms.append((time.monotonic() - began_s) * 1e3)
            number += 1
    times_ms.put(_percentiles(spent_ms))


def _scene(size: Size, seed: int = 0) -> UInt8Array:
    """RGB with about as much detail as a meadow has."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (size[1] // 16, size[0] // 16, 3), np.uint8)
    grain = rng.integers(0, 12, (size[1], size[0], 3), np.uint8)
    return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC) // 2 + grain, np.uint8)


def _timed(call: Callable[[], object]) -> tuple[float, float]:
    call()
    times_ms = []
    for _ in range(ROUNDS):
        began_s = time.perf_counter()
        call()
        times_ms.append((time.perf_counter() - began_s) * 1e3)
    return _percentiles(times_ms)


def _percentiles(times_ms: list[float]) -> tuple[float, float]:
    return float(np.percentile(times_ms, 50)), float(np.percentile(times_ms, 95))


if __name__ == "__main__":
    main()

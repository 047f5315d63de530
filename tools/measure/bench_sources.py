"""Compare cameras: rate, jitter, age and what is lost of each, with the processor's time that an image takes.

python -m tools.measure.bench_sources --device /dev/video0 --pipeline "v4l2src device=/dev/video2" [--json]
python -m tools.measure.bench_sources --topic /bench/image_raw     # which `tools.measure.ros_test_images` publishes

`python -m tools.checks.check_pipelines` tries what can go wrong with pipelines, `tools/checks/check_device.py` with
both.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from flockd.core.config.source import CameraDeviceParameters
from flockd.ground.cameras.watching import Watched
from flockd.onboard.sources.device_source import Devices
from flockd.onboard.sources.devices import CameraDevice, CapturedBuffer

IMAGES, WARM_UP = 200, 10
Size = tuple[int, int]


def main() -> None:
    """Measures one camera after the other, and prints a row of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--device", action="append", default=[], help="of a V4L2 camera; may be repeated")
    parser.add_argument("--pipeline", action="append", default=[], help="of GStreamer; may be repeated")
    parser.add_argument("--topic", action="append", default=[], help="of ROS 2; may be repeated")
    parser.add_argument("--rate", type=float, default=30.0, help="of the cameras, images a second")
    parser.add_argument("--format", choices=("mjpeg", "yuyv"), default="mjpeg", help="of the V4L2 cameras")
    arguments = parser.parse_args()
    if not (arguments.device or arguments.pipeline or arguments.topic):
        parser.error("give --device, --pipeline or --topic")
    cv2.setNumThreads(1)
    size: Size = (arguments.size[0], arguments.size[1])
    cameras = [
        *({"device": device, "pixel_format": arguments.format} for device in arguments.device),
        *({"pipeline": pipeline} for pipeline in arguments.pipeline),
        *({"topic": topic} for topic in arguments.topic),
    ]
    rows = []
    for camera in cameras:
        parameters = CameraDeviceParameters.model_validate({"name": "bench", "rate_hz": arguments.rate, **camera})
        with Devices().open(parameters, size) as device:
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
    """Figures of the images of one camera, after the first ones, which waited for the start."""
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
    p50_ms, p95_ms = np.percentile(ages_ms, [50, 95]).tolist()
    return {
        **{"rate_hz": watched.rate_hz, "jitter_ms": 1e3 * watched.jitter_s(), "age_p50_ms": p50_ms},
        **{"age_p95_ms": p95_ms, "lost": watched.lost, "processor_ms": 1e3 * spent_s / IMAGES},
    }


def _processor_s() -> float:
    """Processor time of this process and of those it started that still run."""
    ticks = 0.0
    for task in Path("/proc/self/task").iterdir():
        for pid in (task / "children").read_text(encoding="ascii").split():
            fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
            ticks += float(fields[11]) + float(fields[12])
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()

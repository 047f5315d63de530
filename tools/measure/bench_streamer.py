"""Measure how regularly setpoints leave while the networks keep every core busy, and print one table.

python -m tools.measure.bench_streamer [--seconds 20] [--json]

A child process streams through MAVSDK to a fake autopilot in this one, first idle, then with the shipped networks
and geometry running without a pause. The times are those at which the kernel handed the packets over. `timer` is a bare
timer of the same period in a third process beside the busy one: how well this computer lets anybody keep time.
Exit code 1: p99 above 60 ms, or a gap of 0.5 s.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import numpy as np

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.data import data_path
from flockd.core.messages import Setpoint
from flockd.flight.inference import OnnxModel
from flockd.flight.inference.feeds import golden_feeds
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot

P99_BAR_MS = 60.0
WORST_BAR_MS = 500.0
WARM_UP_S = 1.0
PERIOD_S = 0.05

Row = dict[str, float]


def main() -> int:
    """Measure and print; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="for each row (20)")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--child", nargs=2, metavar=("PORT", "LOAD"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        port, load = arguments.child
        if load == "timer":
            print(json.dumps(tick(arguments.seconds)))
            return 0
        print(json.dumps(asyncio.run(stream(int(port), arguments.seconds, loaded=load == "busy"))))
        return 0
    idle, _ = measure("idle", arguments.seconds)
    busy, timer = measure("busy", arguments.seconds)
    rows = {"idle": idle, "busy": busy, "timer": timer}
    if arguments.json:
        print(json.dumps(rows, indent=1))
    else:
        print(f"{'process':14s}{'setpoints':>10s}{'p50 ms':>9s}{'p99 ms':>9s}{'max ms':>9s}")
        for load, row in rows.items():
            print(f"{load:14s}{row['count']:10.0f}{row['p50']:9.1f}{row['p99']:9.1f}{row['max']:9.1f}")
    passed = all(row["p99"] <= P99_BAR_MS and row["max"] < WORST_BAR_MS for row in (idle, busy))
    return 0 if passed else 1


def measure(load: str, seconds: float) -> tuple[Row, Row]:
    """The setpoints' intervals beside a load, and those of a bare timer meanwhile."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    with FakeAutopilot(port, height_m=2.5) as fake_autopilot:
        streaming, ticking = child(port, load, seconds), child(port, "timer", seconds)
        begun_s, ended_s = json.loads(streaming.communicate()[0])
        ticks_s = json.loads(ticking.communicate()[0])
        times_s = [time_s for time_s, _ in fake_autopilot.setpoints if begun_s <= time_s <= ended_s]
    return intervals_ms(times_s), intervals_ms(ticks_s)


def child(port: int, load: str, seconds: float) -> subprocess.Popen[bytes]:
    """This program again, in another process."""
    command = [
        sys.executable,
        "-m",
        "tools.measure.bench_streamer",
        "--seconds",
        str(seconds),
        "--child",
        str(port),
        load,
    ]
    return subprocess.Popen(command, stdout=subprocess.PIPE)


def intervals_ms(times_s: list[float]) -> Row:
    """How many times, and median, 99th percentile and longest of the intervals between them."""
    intervals = 1000.0 * np.diff(times_s)
    p50, p99 = np.percentile(intervals, (50, 99))
    return {"count": len(times_s), "p50": float(p50), "p99": float(p99), "max": float(intervals.max())}


def tick(seconds: float) -> list[float]:
    """When a thread that does nothing else woke, on the monotonic clock."""
    deadline_s = time.monotonic() + 2 * WARM_UP_S  # the networks are loaded by then
    times_s = []
    for _ in range(int(seconds / PERIOD_S)):
        deadline_s += PERIOD_S
        time.sleep(max(0.0, deadline_s - time.monotonic()))
        times_s.append(time.monotonic())
    return times_s


async def stream(port: int, seconds: float, *, loaded: bool) -> tuple[float, float]:
    """Streams beside a control task, and a load where wanted; from when to when, on the monotonic clock."""
    parameters = AutopilotParameters(address=f"udpin://127.0.0.1:{port}")
    link = await AutopilotLink.connect(parameters)
    streamer = SetpointStreamer(link.send_setpoint, link.status, lambda setpoint: setpoint, parameters)
    streamer.start()
    streamer.begin()
    stop = threading.Event()
    threads = [threading.Thread(target=work, args=(stop,)) for work in works()] if loaded else []
    for thread in threads:
        thread.start()
    until_s = time.monotonic() + WARM_UP_S + seconds
    while time.monotonic() < until_s:
        streamer.offer(Setpoint(time.monotonic(), np.array([1.0, 0.0]), 2.5, 0.0))
        streamer.beat()
        await asyncio.sleep(PERIOD_S)
    stop.set()
    for thread in threads:
        thread.join()
    streamer.close()
    await link.close()
    return until_s - seconds, until_s


def works() -> list[Callable[[threading.Event], None]]:
    """What a drone computes: all networks in turn, on as many threads as there are cores, and geometry beside them."""
    models = [OnnxModel(path, threads=os.cpu_count() or 1) for path in sorted(data_path("models").glob("*.yaml"))]

    def networks(stop: threading.Event) -> None:
        while not stop.is_set():
            for model in models:
                model.run(golden_feeds(model.manifest))

    def geometry(stop: threading.Event) -> None:
        pairs = np.random.default_rng(0).normal(size=(200, 3, 300))
        while not stop.is_set():
            np.linalg.svd(pairs @ pairs.transpose(0, 2, 1))

    return [networks, geometry]


if __name__ == "__main__":
    raise SystemExit(main())

"""Measures how well TIMESYNC finds the fake autopilot's known clock, on a quiet and on a busy computer.

    python -m tools.measure.bench_timesync
    python -m tools.measure.bench_timesync --seconds 60 --busy 4 --json

The fake autopilot runs in a process of its own and tells how far its clock is off. Under load, as many processes
compute without a pause as `--busy` says. Exit code 1: the offset was off by more than a millisecond.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import socket
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.errors import FlockdError
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tools.measure.bench_daemon import free_port

AHEAD_S = 1234.5678
SETTLE_S = 5.0
"""From the first exchange until errors count."""
SAMPLE_S = 0.1
BAR_S = 1e-3
START_S = 120.0


@dataclass(frozen=True)
class Errors:
    """Of the offset that was found, in milliseconds."""

    busy: int
    samples: int
    median_ms: float
    worst_ms: float
    bound_ms: float
    """What the estimate itself says, at the end."""
    jitter_ms: float
    """Of single measurements, at the end."""
    round_trip_ms: float

    @property
    def within(self) -> bool:
        """Never off by more than the bar."""
        return self.worst_ms <= 1e3 * BAR_S


def measure(seconds: float, busy: int) -> Errors:
    """Follows the estimate for so long, beside ``busy`` processes that compute."""
    context = multiprocessing.get_context("spawn")
    port = free_port(socket.SOCK_DGRAM)
    here, there = context.Pipe()
    with ExitStack() as stack:

        def start(process: SpawnProcess) -> None:
            process.start()
            stack.callback(process.join)
            stack.callback(process.kill)

        start(context.Process(target=_autopilot, args=(port, there), daemon=True))
        if not here.poll(START_S):
            raise FlockdError("the fake autopilot did not start; try again on a quieter computer")
        offset_s = float(here.recv())
        for _ in range(busy):
            start(context.Process(target=_compute, daemon=True))
        return asyncio.run(_follow(port, offset_s, seconds, busy))


async def _follow(port: int, offset_s: float, seconds: float, busy: int) -> Errors:
    parameters = AutopilotParameters(address=f"udpin://127.0.0.1:{port}")
    link = await AutopilotLink.connect(parameters, timeout_s=START_S)
    synchronising = asyncio.create_task(link.synchronise())
    try:
        await asyncio.sleep(SETTLE_S)
        errors_s, until_s = [], time.monotonic() + seconds
        while time.monotonic() < until_s:
            clock = link.clock()
            if clock is not None:
                now = time.monotonic()
                errors_s.append(abs(clock.local_s(now + offset_s) - now))
            await asyncio.sleep(SAMPLE_S)
    finally:
        synchronising.cancel()
        await link.close()
    if clock is None or not errors_s:
        raise FlockdError("the fake autopilot answered no TIMESYNC; try again on a quieter computer")
    errors_s.sort()
    return Errors(
        busy=busy,
        samples=len(errors_s),
        median_ms=round(1e3 * errors_s[len(errors_s) // 2], 3),
        worst_ms=round(1e3 * errors_s[-1], 3),
        bound_ms=round(1e3 * clock.error_s, 3),
        jitter_ms=round(1e3 * clock.jitter_s, 3),
        round_trip_ms=round(1e3 * clock.round_trip_s, 3),
    )


def _autopilot(port: int, told: Connection) -> None:
    """Until it is killed."""
    with FakeAutopilot(port, height_m=2.5, clock_ahead_s=AHEAD_S) as autopilot:
        told.send(autopilot.clock_offset_s)
        while True:
            time.sleep(1.0)


def _compute() -> None:
    while True:
        sum(range(10_000))


def main() -> int:
    """Prints a table, or JSON."""
    parser = argparse.ArgumentParser(description="Errors of TIMESYNC against a fake autopilot's known clock.")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement (20)")
    parser.add_argument("--busy", type=int, default=4, help="processes that compute, in the second measurement (4)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args()
    try:
        measured = [measure(args.seconds, busy) for busy in (0, args.busy)]
    except FlockdError as error:
        print(error, file=sys.stderr)
        return int(error.exit_code)
    if args.json:
        print(json.dumps({"measured": [asdict(one) for one in measured]}, indent=2))
    else:
        print("| busy processes | samples | median error | worst error | own bound | jitter | round trip |")
        print("|---|---|---|---|---|---|---|")
        for one in measured:
            numbers = (one.median_ms, one.worst_ms, one.bound_ms, one.jitter_ms, one.round_trip_ms)
            print(f"| {one.busy} | {one.samples} | " + " | ".join(f"{number:.3f} ms" for number in numbers) + " |")
    return 0 if all(one.within for one in measured) else 1


if __name__ == "__main__":
    sys.exit(main())

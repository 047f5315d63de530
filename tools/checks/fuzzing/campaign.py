"""Gives a target its inputs one after the other, in a process of its own with bounds on time and memory."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import resource
import signal
import tempfile
import time
import traceback
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import Any

from tools.checks.fuzzing.target import ROOT, Target

LISTED = 5
"""Inputs of each kind of finding that are listed."""


@dataclass(frozen=True)
class Bounds:
    """What one input may take."""

    cpu_s: float = 5.0
    wall_s: float = 60.0
    """For one that waits instead of computing; generous, as the computer may be busy."""
    memory_bytes: int = 1 << 30
    """Above what the process had before its first input."""


class HangError(BaseException):
    """An input took too long. No handler of ordinary errors may take it for its own."""


@dataclass
class Finding:
    """A kind of failure, by where it happened."""

    target: str
    what: str
    """Error type, its text, and the innermost place in flockd or its checks."""
    inputs: list[int] = field(default_factory=list)
    """Numbers of some that cause it."""
    count: int = 0
    trace: str = ""


@dataclass
class Result:
    """What became of one target."""

    target: str
    inputs: int = 0
    seconds: float = 0.0
    grown_mb: float = 0.0
    """The largest memory of the process, after its first hundred inputs."""
    findings: dict[str, Finding] = field(default_factory=dict)

    def note(self, number: int, what: str, trace: str) -> None:
        """Counts a failure under its kind."""
        finding = self.findings.setdefault(what, Finding(self.target, what, trace=trace))
        finding.count += 1
        if len(finding.inputs) < LISTED:
            finding.inputs.append(number)


def randomness(seed: int, target: str, number: int) -> Random:
    """That of one input, whatever came before it."""
    return Random(f"{seed}/{target}/{number}")


def run(target: Target, seed: int, first: int, count: int, bounds: Bounds | None = None) -> Result:
    """Gives a target its inputs from number ``first`` on; a process that dies or hangs is a finding, and replaced."""
    result, begun_s = Result(target.name), time.monotonic()
    at = first
    while at < first + count:
        at = _run_process(result, target, bounds or Bounds(), seed, at, first + count)
    result.inputs, result.seconds = count, time.monotonic() - begun_s
    return result


def _run_process(result: Result, target: Target, bounds: Bounds, seed: int, first: int, end: int) -> int:
    """One process; gives the number of the next input that has to be tried."""
    context = multiprocessing.get_context("spawn")
    progress = context.RawValue(ctypes.c_int64, first - 1)
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(target, bounds, seed, first, end, progress, there), daemon=True)
    process.start()
    there.close()
    moved = (first - 1, time.monotonic())
    while True:
        try:
            if here.poll(0.2):
                _take(result, here.recv())
        except EOFError:
            break
        if progress.value != moved[0]:
            moved = (progress.value, time.monotonic())
        elif time.monotonic() - moved[1] > bounds.wall_s:
            process.kill()
            process.join()
            result.note(moved[0], f"HangError: waits for more than {bounds.wall_s:g} s", "")
            return max(moved[0], first) + 1
    process.join()
    if process.exitcode == 0:
        return end
    if progress.value < first:
        raise RuntimeError(f"{target.name}: cannot be prepared; its process ended with {process.exitcode}")
    result.note(progress.value, f"the process ended with {process.exitcode}", "")
    return progress.value + 1


def _take(result: Result, message: Any) -> None:
    """What a process sent: a failure, or at its end how much its memory has grown."""
    if isinstance(message, float):
        result.grown_mb = max(result.grown_mb, message)
    else:
        result.note(*message)


def _work(target: Target, bounds: Bounds, seed: int, first: int, end: int, progress: Any, there: Connection) -> None:
    """In a process of its own."""
    os.chdir(ROOT)
    signal.signal(signal.SIGPROF, _hang)
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None) as folder:
        check = target.prepare(Path(folder))
        _bound_memory(bounds.memory_bytes)
        with Path(os.devnull).open("w") as nowhere:  # what decoders write about damaged images
            os.dup2(nowhere.fileno(), 2)
        usual_mb = 0.0
        for number in range(first, end):
            progress.value = number
            if number == first + 100:
                usual_mb = _peak_mb()
            try:
                signal.setitimer(signal.ITIMER_PROF, bounds.cpu_s)
                check(randomness(seed, target.name, number))
            except (Exception, HangError) as error:  # noqa: BLE001 - every one of them is a finding
                there.send((number, _kind(error), traceback.format_exc(limit=-8)))
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0.0)
        there.send(max(_peak_mb() - usual_mb, 0.0) if usual_mb else 0.0)
    there.close()
    os._exit(0)  # an open zenoh session now and then holds up a process's end for ever


def _hang(number: int, frame: object) -> None:
    raise HangError("takes too long")


def _bound_memory(extra_bytes: int) -> None:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + extra_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _kind(error: BaseException) -> str:
    """By type and place, so that inputs with one cause are one finding."""
    places = [frame for frame in traceback.extract_tb(error.__traceback__) if str(ROOT) in frame.filename]
    ours = [frame for frame in places if "/flockd/" in frame.filename] or places
    where = f"{Path(ours[-1].filename).relative_to(ROOT)}:{ours[-1].lineno}" if ours else "?"
    return f"{type(error).__name__} at {where}: {str(error).splitlines()[0][:120] if str(error) else ''}"

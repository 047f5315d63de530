"""The engines give what flying in this process gives, also when processes or the campaign itself are killed."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flockd.campaign.engine import ProcessEngine
from flockd.campaign.flight_kinds import FlownRun
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.folder import LINES_NAME
from tests.campaign.flights import PAPER, Shuffled, campaign_file, flown, fly_or_end

FEW = f"campaign: test\nscenario: {PAPER}\nseeds: 3\nscatter_m: 0.5\nfixed: {{duration_s: 2}}\n"


def few(folder: Path, seeds: int = 3, duration_s: float = 2.0) -> Plan:
    text = FEW.replace("seeds: 3", f"seeds: {seeds}").replace("duration_s: 2", f"duration_s: {duration_s}")
    return Plan.load(campaign_file(folder, "", text))


def table(plan: Plan, folder: Path, engine: ProcessEngine) -> bytes:
    flown(plan, folder, engine)
    return (folder / "flights.csv").read_bytes()


def expected(plan: Plan, folder: Path) -> bytes:
    return table(plan, folder / "expected", Shuffled(1))


def test_a_process_gives_the_same_flights(tmp_path: Path) -> None:
    plan = few(tmp_path)
    with ProcessEngine(1) as engine:
        assert table(plan, tmp_path / "out", engine) == expected(plan, tmp_path)
    lines = (tmp_path / "out" / LINES_NAME).read_text().splitlines()
    assert os.getpid() not in {json.loads(line)["process"] for line in lines}


@pytest.mark.slow
@pytest.mark.whole_flight
def test_a_process_that_dies_is_replaced(tmp_path: Path) -> None:
    """Both processes are killed as soon as they fly, and one again; all flights are there once."""
    plan = few(tmp_path, seeds=12, duration_s=10.0)
    killed: list[int] = []

    def kill_some() -> None:
        while len(killed) < 3:
            for pid in workers_of(os.getpid()) - set(killed):
                if len(killed) < 3:
                    killed.append(pid)
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.2)

    with ProcessEngine(2) as engine:
        threading.Thread(target=kill_some, daemon=True).start()
        assert table(plan, tmp_path / "out", engine) == expected(plan, tmp_path)
    assert len(killed) == 3


def workers_of(parent: int) -> set[int]:
    """Processes that a process has started to fly."""
    found = set()
    for entry in Path("/proc").iterdir():
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            words = (entry / "cmdline").read_text()
        except (OSError, ValueError):
            continue
        if entry.name.isdigit() and int(fields[1]) == parent and "popen_loky" in words:
            found.add(int(entry.name))
    return found


@pytest.mark.slow
@pytest.mark.whole_flight
def test_a_flight_that_ends_its_process_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One flight always ends its process; the others, which were lost with it, are flown."""
    monkeypatch.setattr("flockd.campaign.engine.fly_task", fly_or_end)
    plan, results = few(tmp_path), list[FlownRun]()
    with ProcessEngine(2) as engine:
        for number in range(3):
            engine.submit(plan.task(plan.cells[0], number))
        while len(results) < 3:
            results += engine.wait()
    reasons = {one.run: one.reason for one in results}
    assert reasons[Run(0, 0)] is reasons[Run(0, 2)] is None
    assert "the process that flew it ended, 3 times" in (reasons[Run(0, 1)] or "")


@contextmanager
def command(path: Path, out: Path, *more: str) -> Iterator[subprocess.Popen[bytes]]:
    """`flockd campaign` of a file, as a person runs it."""
    program = "from flockd.cli import program; program()"
    words = [sys.executable, "-c", program, "campaign", str(path), "--out", str(out), *more]
    with subprocess.Popen(words, cwd=Path(__file__).parents[2], stderr=subprocess.DEVNULL) as process:
        yield process


@pytest.mark.slow
@pytest.mark.whole_flight
def test_20_kills_lose_nothing_and_double_nothing(tmp_path: Path) -> None:
    """Each kill comes at a random moment after the campaign has flown some more; its processes end with it."""
    plan = few(tmp_path, seeds=400, duration_s=20.0)
    path, out = tmp_path / "test.yaml", tmp_path / "out"
    random_moment = random.Random(5)
    finished: set[str] = set()
    for kill in range(20):
        with command(path, out, "--workers", "2") as process:
            aim = len(finished) + random_moment.randrange(0, 8)
            while process.poll() is None and len(names_in(out)) <= aim:
                time.sleep(0.05)
            time.sleep(random_moment.random())
            workers = workers_of(process.pid)
            process.kill()
        now = names_in(out)
        assert finished <= now, f"kill {kill} lost flights"
        finished = now
        until = time.monotonic() + 60
        while any(Path(f"/proc/{pid}/cmdline").exists() for pid in workers) and time.monotonic() < until:
            time.sleep(0.1)
        assert not any(Path(f"/proc/{pid}/cmdline").exists() for pid in workers), "its processes fly on"
    assert 0 < len(finished) < 400
    with command(path, out, "--workers", "2") as process:
        assert process.wait() == 0
    assert (out / "flights.csv").read_bytes() == expected(plan, tmp_path)


def names_in(out: Path) -> set[str]:
    """Flights that a folder holds."""
    path = out / LINES_NAME
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    runs = [json.loads(line)["run"] for line in lines if line.endswith("\n")]
    return {f"c{run['cell']}-s{run['number']}" for run in runs}

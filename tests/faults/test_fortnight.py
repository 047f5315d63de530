"""A fortnight of flights with one drone: batteries are changed, the computer boots in the past, and its disk fills."""

from __future__ import annotations

import _thread
import asyncio
import gc
import logging
import os
import re
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from flockd.core.config import DroneConfig
from flockd.onboard.recording.mcap_file import McapFile, Note, read_records
from flockd.onboard.recording.reader import Recording, flight_number, head_of
from flockd.onboard.recording.streams import FLIGHT_NOTE, FLIGHT_NUMBER, FRAMES
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tests.calm import clock
from tests.calm import until as until_real
from tests.faults.conftest import never_alone
from tests.onboard.autopilot.conftest import HEARTBEAT_S
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import SECONDS_TO_FAIL, Aboard, aboard, watched

BOOT = datetime(2024, 1, 1, tzinfo=UTC)
"""Where a clock without a battery begins."""
DISK_BYTES = 400_000
"""Three flights of some seconds."""
BEFORE = Path(__file__).parents[1] / "review" / "replay" / "normal.mcap"
"""Of an earlier version, whose recordings had no number."""
MORE_FILES, MORE_MB_A_FLIGHT = 2, 2.5
"""What may be there after the last flight and was not after the first: sockets of zenoh that close late, and what
allocators, and the fake autopilot, keep."""


@dataclass
class Fortnight:
    """What the flights of a drone leave behind."""

    folder: Path
    booted_s: float = 0.0
    begun: list[str] = field(default_factory=list)
    """Names of the recordings, in the order of the flights."""
    told: list[str] = field(default_factory=list)
    """All events."""
    left: list[tuple[int, Counter[str], float]] = field(default_factory=list)
    """This process's files, threads and MB after each flight."""

    def now(self, zone: tzinfo | None = None) -> datetime:
        """The computer's wall clock."""
        return (BOOT + timedelta(seconds=clock() - self.booted_s)).astimezone(zone)

    def disk(self, _: Path) -> Any:
        """A small one, of recordings alone."""
        taken = sum(file.stat().st_size for file in self.folder.iterdir())
        return SimpleNamespace(total=DISK_BYTES, free=DISK_BYTES - taken)

    def newest(self) -> tuple[int, Path]:
        """By the flights' own numbers."""
        return max((flight_number(head_of(file)[0].facts), file) for file in self.folder.iterdir())


def _recording_of_before(target: Path) -> None:
    """Of this drone: the first steps of a recorded flight, without a number."""
    with McapFile(target) as file:
        for record in read_records(BEFORE):
            if isinstance(record, Note) and record.name == FLIGHT_NOTE:
                kept = {key: text for key, text in record.facts.items() if key != FLIGHT_NUMBER}
                record = Note(FLIGHT_NOTE, {**kept, "drone": "tiny"})  # noqa: PLW2901 - the same, of another drone
            file.write(record)  # type: ignore[arg-type]
            if getattr(record, "stream", None) == FRAMES and file.size > DISK_BYTES // 8:
                break


def _open() -> tuple[int, Counter[str], float]:
    """Files, threads and MB, without the shared memory that zenoh keeps of each publisher of frames."""
    gc.collect()
    files = [file.readlink() for file in Path("/proc/self/fd").iterdir() if file.is_symlink()]
    status = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (kb,) = (int(line.split()[1]) for line in status if line.startswith("RssAnon"))
    own = [file for file in files if file.suffix != ".zenoh"]
    return len(own), _threads(), kb / 1e3


def _threads() -> Counter[str]:
    """Python's by their names without numbers, less the pool of this story's loop; `native`: MAVSDK's, by the kernel.

    Zenoh's have names of their own there, and close late. A dummy is Python's record of a native thread that has
    written a line to the log, and stays when that has ended.
    """
    known = Counter(re.sub(r"\d", "", thread.name) for thread in threading.enumerate())
    del known["Dummy-"]
    tasks = [task.joinpath("comm").read_text(encoding="utf-8") for task in Path("/proc/self/task").iterdir()]
    known["native"] = tasks.count(Path("/proc/self/comm").read_text(encoding="utf-8")) - known.total()
    del known["asyncio_"]
    return known


def test_a_thread_that_stays_is_noticed_and_a_line_in_the_log_by_a_native_one_is_not() -> None:
    """MAVSDK's thread complains when the computer is slow."""
    before, stays, dummies = _threads(), threading.Event(), str(threading.enumerate()).count("Dummy")
    _thread.start_new_thread(logging.getLogger("flockd").warning, ("slow",))
    until_real(lambda: str(threading.enumerate()).count("Dummy") > dummies)
    until_real(lambda: _threads() == before)
    thread = threading.Thread(target=stays.wait, name="leaked 3", daemon=True)
    thread.start()
    assert _threads() - before == Counter({"leaked ": 1})
    stays.set()
    thread.join()


async def fly_a_fortnight(
    boots: int, flights_a_boot: int, tmp_path: Path, port: int, patch: Callable[..., None]
) -> None:
    """So many flights: takes off, flies, loses what comes and goes, lands by an order, disarms."""
    days = Fortnight(tmp_path / "recordings")
    days.folder.mkdir()
    _recording_of_before(days.folder / "tiny-20260901T000000000000Z.mcap")
    for module in ("daemon.message_sinks", "recording.recorder"):
        patch(f"flockd.onboard.{module}.datetime", days)
    patch("shutil.disk_usage", days.disk)
    for boot in range(boots):
        days.booted_s = clock()
        own = tmp_path / f"boot{boot}"
        own.mkdir()
        change = _as_recorded(days, boot)
        with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S, clock=clock) as autopilot:  # carried home, a new battery
            async with aboard(autopilot, port, own, recordings=days.folder, change=change) as ship:
                for flight in range(flights_a_boot):
                    await _one_flight(ship, days, camera_goes=flight % 2 == 0)
                days.told += ship.events
        assert ship.ending.exception() is None
    _judge(days)


def _as_recorded(days: Fortnight, boot: int) -> Callable[[DroneConfig], DroneConfig]:
    """Every other boot the drone is set up anew, from what its last recording says of it; ports are this boot's."""

    def change(config: DroneConfig) -> DroneConfig:
        if boot % 2 == 1:
            ports = {key: getattr(config, key) for key in ("source", "autopilot", "telemetry")}
            config = Recording(days.newest()[1]).config.model_copy(update=ports)
        return never_alone(config)

    return change


async def _one_flight(ship: Aboard, days: Fortnight, *, camera_goes: bool) -> None:
    autopilot, (number, _) = ship.fake_autopilot, days.newest()
    await ship.until_state("idle")
    await until(lambda: "started" not in ship.matters() and "link_lost" not in ship.matters(), SECONDS_TO_FAIL)
    autopilot.pilot_arms()
    autopilot.pilot_selects("TAKEOFF")
    await ship.until_state("ready")
    await until(lambda: autopilot.mode == "LOITER", SECONDS_TO_FAIL)
    await ship.flies()
    if camera_goes:
        ship.cameras.silent.add("back")
        await ship.until_matters("camera_lost")
        ship.cameras.silent.clear()
        await ship.until_matters(over=("camera_lost",))
    else:
        async with asyncio.timeout(SECONDS_TO_FAIL):
            assert await asyncio.to_thread(_watched_meanwhile, ship.config.telemetry.listen[0])
    await ship.steps_on(3)
    assert ship.heard()["computer"].message["messages_lost"] == 0
    assert (await ship.ask("ask/land"))["accepted"] is True
    await until(lambda: autopilot.mode != "OFFBOARD", SECONDS_TO_FAIL)
    autopilot.pilot_selects("LAND")  # as flockd has asked for, where a busy computer has not let go of it before
    await until(lambda: not autopilot.armed, SECONDS_TO_FAIL)
    await ship.until_matters("not_armed", over=("land_asked",))
    await until(lambda: ship.heard()["computer"].message["recording"] is None, SECONDS_TO_FAIL)
    await until(lambda: Recording(days.newest()[1]).contents.finished, SECONDS_TO_FAIL)
    now, path = days.newest()
    flown = Recording(path)
    assert now > number, "each flight has the next number, whatever the clock says"
    assert (flown.contents.lost, flown.contents.gaps) == (0, ())
    assert len(list(flown.steps())) > 3
    assert path.name.startswith(f"tiny-{BOOT:%Y%m%d}"), "as the clock has it"
    os.utime(path, (days.now().timestamp(), days.now().timestamp()))
    days.begun.append(path.name)
    days.left.append(_open())


def _watched_meanwhile(endpoint: str) -> bool:
    """Somebody looks for a moment, beside the event loop on which the drone flies."""
    with watched(endpoint, clock) as (watcher, _, _):
        until_s = clock() + SECONDS_TO_FAIL
        while not (heard := bool(watcher.drones())) and clock() < until_s:
            time.sleep(0.02)
    return heard


def _judge(days: Fortnight) -> None:
    """Nothing was lost that had to be kept, and nothing stayed open."""
    flights, kept = len(days.begun), {file.name for file in days.folder.iterdir()}
    assert {*days.begun[-2:]} <= kept, "the last two"
    count = len(kept)
    assert count < flights, "the disk was full"
    assert {*days.begun[-count:]} == kept, "the oldest went first, that of before among them"
    assert sum((days.folder / name).stat().st_size for name in kept) < DISK_BYTES
    gone = [event for event in days.told if "was deleted, as the disk is full" in event]
    assert len(gone) >= flights + 1 - count, "and each was told"
    assert not any("the recording ends here" in event for event in days.told)
    (files, threads, mb), (files_now, threads_now, mb_now) = days.left[0], days.left[-1]
    print(  # noqa: T201 - figures
        f"{flights} flights, {count} recordings of {sum((days.folder / name).stat().st_size for name in kept)} bytes "
        f"kept, {len(gone)} deleted for room; files {files} -> {files_now}, "
        f"threads {threads.total()} -> {threads_now.total()}, memory {mb:.0f} -> {mb_now:.0f} MB"
    )
    assert files_now - files <= MORE_FILES, days.left
    assert threads_now == threads, (threads_now - threads, threads - threads_now)
    assert mb_now - mb <= MORE_MB_A_FLIGHT * flights, days.left


@pytest.mark.slow
@pytest.mark.fault("weeks-in-service")
async def test_four_flights_of_a_fortnight(tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole of it is flown by hand (`test_whole_fortnight.py`)."""
    await fly_a_fortnight(2, 2, tmp_path, port, monkeypatch.setattr)

"""Disk, memory, temperature and clocks of computers that are well and of computers that are not."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from flockd.core.config import load_drone
from flockd.core.data import data_path
from flockd.ground.doctor import Level
from flockd.ground.doctor.computer_checks import (
    check_clock,
    check_disk,
    check_memory,
    check_temperature,
    judge_room,
)
from flockd.review.replay.profile import ComputerFiles, Watch
from tests import make

QUADROTOR = load_drone(data_path("config") / "quadrotor.yaml")


def test_a_folder_for_recordings_is_written_and_left_as_it_was(tmp_path: Path) -> None:
    (finding,) = check_disk(make.changed(QUADROTOR, recording__quota_mb=1.0), tmp_path)
    assert (finding.level, list(tmp_path.iterdir())) == (Level.PASS, [])
    (finding,) = check_disk(QUADROTOR, tmp_path / "none")
    assert (finding.level, finding.about) == (Level.FAILURE, "disk")
    (finding,) = check_disk(QUADROTOR, None, tmp_path / "none")
    assert finding.level is Level.WARNING, "none is named"
    for drone in ("drone1", "drone2"):
        (tmp_path / f"{drone}-20260101T000000000000Z.mcap").write_bytes(b"x" * 60_000_000)
    (finding,) = check_disk(QUADROTOR, None, tmp_path)
    assert "0.1 GB are this drone's recordings" in finding.measured, "those of others make no room"


@pytest.mark.parametrize(
    ("free_mb", "own_mb", "level"),
    [
        (21_000.0, 0.0, Level.PASS),
        (5_000.0, 16_000.0, Level.PASS),  # what it has recorded makes room for what it will
        (19_000.0, 0.0, Level.WARNING),
        (1_500.0, 400.0, Level.FAILURE),  # less than a flight
    ],
)
def test_room_for_the_quota(free_mb: float, own_mb: float, level: Level) -> None:
    assert QUADROTOR.recording.quota_mb == 20000.0
    assert judge_room(QUADROTOR, Path("/r"), free_mb, own_mb).level is level


@pytest.mark.parametrize(
    ("available_kb", "queue_mb", "level"),
    [
        (4_000_000, 64.0, Level.PASS),
        (500_000, 64.0, Level.WARNING),
        (300_000, 64.0, Level.FAILURE),
        (1_000_000, 1000.0, Level.FAILURE),
    ],
)
def test_memory(available_kb: int, queue_mb: float, level: Level, tmp_path: Path) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text(f"MemTotal:  8000000 kB\nMemFree: 1 kB\nMemAvailable: {available_kb} kB\n", encoding="ascii")
    (finding,) = check_memory(make.changed(QUADROTOR, recording__queue_mb=queue_mb), meminfo)
    assert finding.level is level
    assert f"{available_kb * 1024 / 1e6:.0f} of 8192 MB" in finding.measured


def _computer(folder: Path, **hot: tuple[str, str]) -> Path:
    for name, (kind, reading) in hot.items():
        (folder / name).mkdir()
        (folder / name / "type").write_text(f"{kind}\n", encoding="ascii")
        file = "cur_state" if name.startswith("cooling") else "temp"
        (folder / name / file).write_text(f"{reading}\n", encoding="ascii")
    return folder


@pytest.mark.parametrize(
    ("reading", "level"), [("51000", Level.PASS), ("78000", Level.WARNING), ("86000", Level.FAILURE)]
)
def test_the_hottest_zone_counts(reading: str, level: Level, tmp_path: Path) -> None:
    zones = {"thermal_zone0": ("board", "40000"), "thermal_zone1": ("cpu", reading), "thermal_zone2": ("off", "")}
    (finding,) = check_temperature(QUADROTOR, tmp_path)
    assert finding.level is Level.WARNING, "it reports none"
    (finding,) = check_temperature(QUADROTOR, _computer(tmp_path, **zones))
    assert (finding.level, finding.about) == (level, "temperature")
    assert finding.measured.startswith(f"{reading[:2]} °C (cpu)")


def test_a_processor_that_is_slowed_down_and_a_fan_that_runs(tmp_path: Path) -> None:
    devices = {"cooling_device0": ("pwm-fan", "3"), "cooling_device1": ("cpufreq-cpu0", "0")}
    folder = _computer(tmp_path, thermal_zone0=("cpu", "50000"), **devices)
    assert [finding.level for finding in check_temperature(QUADROTOR, folder)] == [Level.PASS]
    (folder / "cooling_device1" / "cur_state").write_text("2\n", encoding="ascii")
    slowed, _ = check_temperature(QUADROTOR, folder)
    assert slowed.level is Level.WARNING
    assert "cpufreq-cpu0" in slowed.measured


@pytest.mark.parametrize(
    ("synchronised", "year", "level"),
    [(True, 2026, Level.PASS), (False, 2026, Level.WARNING), (True, 1970, Level.FAILURE)],
)
def test_clocks(synchronised: bool, year: int, level: Level) -> None:
    (finding,) = check_clock(lambda: synchronised, lambda: datetime(year, 7, 1, 12, tzinfo=UTC))
    assert (finding.level, finding.about) == (level, "wall clock")


PI_5 = """processor	: 0
BogoMIPS	: 108.00
Features	: fp asimd evtstrm aes pmull sha1 sha2 crc32 atomics fphp asimdhp cpuid asimdrdm lrcpc dcpop asimddp
CPU implementer	: 0x41
CPU part	: 0xd0b

Model		: Raspberry Pi 5 Model B Rev 1.0
"""
SERVER = """model name	: AMD EPYC 9354
flags		: fpu sse4_2 avx2 avx512f avx512bw avx512_vnni avx_vnni
model name	: another core's
"""


@pytest.mark.parametrize(
    ("cpuinfo", "name", "eight_bit"),
    [
        (PI_5, "Raspberry Pi 5 Model B Rev 1.0", ("dotprod",)),
        (SERVER, "AMD EPYC 9354", ("AVX-512 VNNI", "AVX-VNNI")),
        ("", "unknown", ()),
    ],
)
def test_a_computer_says_which_instructions_it_has(
    cpuinfo: str, name: str, eight_bit: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "cpuinfo").write_text(cpuinfo, encoding="utf-8")
    (tmp_path / "meminfo").write_text("MemTotal:  8000000 kB\n", encoding="ascii")
    computer = ComputerFiles(tmp_path / "cpuinfo", tmp_path / "none", tmp_path / "meminfo").computer()
    assert (computer["name"], computer["eight_bit"]) == (name, list(eight_bit))
    assert computer["memory_mb"] == pytest.approx(8192.0)
    assert computer["cores"] >= 1
    (tmp_path / "model").write_bytes(b"NVIDIA Jetson Orin Nano Developer Kit\0")
    board = ComputerFiles(tmp_path / "cpuinfo", tmp_path / "model", tmp_path / "none").computer()
    assert (board["name"], board["memory_mb"]) == ("NVIDIA Jetson Orin Nano Developer Kit", None)


def test_how_a_computer_does_now(tmp_path: Path) -> None:
    thermal = tmp_path / "thermal"
    thermal.mkdir()
    _computer(
        thermal,
        thermal_zone0=("board", "40000"),
        thermal_zone1=("cpu-thermal", "61500"),
        cooling_device0=("cpufreq-cpu0", "2"),
    )
    told = Watch(ComputerFiles(thermal=thermal)).summary()
    del told["load_before"]
    assert told == {"temperature_c": [61.5] * 3, "slowed_by": ["cpufreq-cpu0"]}
    told = Watch(ComputerFiles(thermal=tmp_path / "none")).summary()
    assert (told["temperature_c"], told["slowed_by"]) == (None, [])

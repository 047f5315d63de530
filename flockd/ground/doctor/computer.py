"""What a computer is, and how it does while it works: what a figure of time has to stand beside."""

from __future__ import annotations

import os
import platform
import resource
from dataclasses import dataclass
from pathlib import Path

from flockd.ground.doctor.computer_checks import MB, MEMORY, THERMAL, processors_slowed, thermal_zones

CPUINFO = Path("/proc/cpuinfo")
BOARD = Path("/proc/device-tree/model")
"""A board with a device tree says there what it is."""
CLOCKS = Path("/sys/devices/system/cpu")
INSTRUCTIONS = {
    "amx_int8": "AMX",
    "avx512_vnni": "AVX-512 VNNI",
    "avx_vnni": "AVX-VNNI",
    "i8mm": "I8MM",
    "asimddp": "dotprod",
}
"""Of 8-bit products, by the kernel's names of them: with none of these the 8-bit networks save little."""
OTHERS = {"avx512f": "AVX-512", "avx2": "AVX2", "sve2": "SVE2", "sve": "SVE", "asimd": "NEON"}
"""Of numbers in float, the widest first."""


@dataclass(frozen=True)
class Computer:
    """What it is."""

    name: str
    """Of the board where it has one, else of the processor."""
    architecture: str
    cores: int
    """That this process may use."""
    eight_bit: tuple[str, ...]
    """Its instructions for 8-bit products; none: the 8-bit networks save little."""
    vector: tuple[str, ...]
    """Its other vector instructions."""
    memory_mb: float | None

    @classmethod
    def this(cls, cpuinfo: Path = CPUINFO, board: Path = BOARD, meminfo: Path = MEMORY) -> Computer:
        """The one that this runs on; files are the kernel's. What cannot be read is "unknown" or None."""
        facts = _facts(_text(cpuinfo))
        flags = (facts.get("flags") or facts.get("Features") or "").split()
        return cls(
            name=_text(board).strip("\0\n ") or facts.get("Model") or facts.get("model name") or "unknown",
            architecture=platform.machine(),
            cores=len(os.sched_getaffinity(0)),
            eight_bit=tuple(name for flag, name in INSTRUCTIONS.items() if flag in flags),
            vector=tuple(name for flag, name in OTHERS.items() if flag in flags),
            memory_mb=_total_mb(_text(meminfo)),
        )


@dataclass(frozen=True)
class Condition:
    """How it does at one moment."""

    temperature_c: float | None
    """Of the hottest zone; None where it reports none."""
    zone: str
    """That zone's name."""
    slowed: tuple[str, ...]
    """Cooling devices that slow its processor down now."""
    clock_mhz: float | None
    """Of its fastest core now; None where it is not told."""

    @classmethod
    def now(cls, thermal: Path = THERMAL, clocks: Path = CLOCKS) -> Condition:
        """Of this computer; folders are the kernel's."""
        zones = dict(thermal_zones(thermal))
        hottest = max(zones, key=zones.__getitem__, default="")
        mhz = [text for file in clocks.glob("cpu[0-9]*/cpufreq/scaling_cur_freq") if (text := _text(file).strip())]
        return cls(
            temperature_c=zones.get(hottest),
            zone=hottest,
            slowed=tuple(sorted(processors_slowed(thermal))),
            clock_mhz=max((int(text) / 1e3 for text in mhz), default=None),
        )


def peak_memory_mb() -> float:
    """The most that this process has held so far, resident."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MB


def _facts(cpuinfo: str) -> dict[str, str]:
    """The first value of each key: one processor speaks for all."""
    facts: dict[str, str] = {}
    for line in cpuinfo.splitlines():
        key, colon, value = line.partition(":")
        if colon:
            facts.setdefault(key.strip(), value.strip())
    return facts


def _total_mb(meminfo: str) -> float | None:
    total = _facts(meminfo).get("MemTotal")
    return None if total is None else int(total.split()[0]) * 1024 / MB


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""

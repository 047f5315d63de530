"""Where a replay's time went, on which computer, and how often that computer can step."""

from __future__ import annotations

import math
import os
import platform
import resource
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from flockd import __version__
from flockd.core.config import DroneConfig
from flockd.flight.inference import manifests_of
from flockd.ground.doctor.computer_checks import MB, MEMORY, THERMAL, processors_slowed, thermal_zones
from flockd.ground.doctor.model_checks import FULL
from flockd.review.replay.recorded_flight import Replay

LEAST_STEPS = 5
"""Of fewer the slowest twentieth is a single one, and the first does not count."""
_ROUND_TO_S = 0.05
_LIBRARIES = ("onnxruntime", "onnxruntime-gpu", "openvino", "opencv-python-headless", "numpy")
"""Packages that decide how fast it is; one of the runtimes is installed."""
STEP = "step"
"""The row of all stages together, and what is between them."""


@dataclass(frozen=True)
class Row:
    """One stage of a step."""

    stage: str
    p50_ms: float
    p95_ms: float
    share: float
    """Of the steps' time."""


@dataclass(frozen=True)
class Profile:
    """Where time went in the steps after the first, which has no images before it, and warms up."""

    rows: tuple[Row, ...]
    """In the order of the step; the last is the whole step."""
    steps: int
    processor_ms: float
    """Processor time of a step, all threads together, median."""
    cores_busy: float
    """By this process while it steps, on average."""
    step_s: float
    """Configured."""
    least_step_s: float
    """The shortest step time that leaves a fifth of it for what else the drone's computer does."""

    @classmethod
    def of(cls, replay: Replay, config: DroneConfig) -> Profile:
        """Raises ValueError for a replay of fewer than `LEAST_STEPS`."""
        if len(replay.steps_ms) < LEAST_STEPS:
            raise ValueError(f"{len(replay.steps_ms)} steps are too few to say where time goes")
        steps_ms, processor_ms = replay.steps_ms[1:], replay.processor_ms[1:]
        whole_ms = sum(steps_ms)
        stages = {stage: samples[-len(steps_ms) :] for stage, samples in replay.stages_ms.items()}
        rows = [_row(stage, samples, whole_ms) for stage, samples in stages.items()]
        step = _row(STEP, steps_ms, whole_ms)
        needed_s = step.p95_ms / 1e3 / (FULL * config.safety.degraded_load)
        return cls(
            rows=(*rows, step),
            steps=len(steps_ms),
            processor_ms=float(np.median(processor_ms)),
            cores_busy=sum(processor_ms) / whole_ms,
            step_s=config.step_s,
            least_step_s=round(math.ceil(needed_s / _ROUND_TO_S - 1e-9) * _ROUND_TO_S, 2),
        )


def _row(stage: str, samples_ms: Sequence[float], whole_ms: float) -> Row:
    p50, p95 = np.percentile(samples_ms, (50, 95))
    return Row(stage, float(p50), float(p95), sum(samples_ms) / whole_ms)


class Watch:
    """Notes how the computer does while a replay goes on."""

    def __init__(self) -> None:
        self.computer = Computer.this()
        self._load = os.getloadavg()[0]
        self._seen = [Condition.now()]

    def look(self) -> None:
        """Once a step."""
        self._seen.append(Condition.now())

    def summary(self) -> dict[str, Any]:
        """Processes that wanted a core before it began (the average of a minute); temperatures in °C at the start, at
        most and at the end; the clock at least and at most; what slowed the processor. None: not told.
        """
        temperatures = [one.temperature_c for one in self._seen if one.temperature_c is not None]
        clocks = [one.clock_mhz for one in self._seen if one.clock_mhz is not None]
        return {
            "load_before": self._load,
            "temperature_c": [temperatures[0], max(temperatures), temperatures[-1]] if temperatures else None,
            "zone": self._seen[-1].zone or None,
            "slowed_by": sorted({device for one in self._seen for device in one.slowed}),
            "clock_mhz": [min(clocks), max(clocks)] if clocks else None,
        }


def _settings(config: DroneConfig) -> dict[str, Any]:
    """What of the configuration decides how long a step takes."""
    wanted = config.perception
    return {
        "networks": [path.stem for path in manifests_of(wanted)],
        "provider": wanted.provider,
        "threads": wanted.threads,
        "cameras": {camera.name: list(camera.size_px) for camera in config.rig.cameras},
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def profile_result(replay: Replay, config: DroneConfig, watch: Watch, memory_mb: float) -> dict[str, Any]:
    """All of it as JSON. Raises ValueError for a replay of fewer than `LEAST_STEPS`."""
    profile = Profile.of(replay, config)
    return {
        "versions": {
            "flockd": __version__,
            **{name: version for name in _LIBRARIES if (version := _version(name)) is not None},
            "python": platform.python_version(),
        },
        "computer": asdict(watch.computer),
        **_settings(config),
        **watch.summary(),
        "memory_mb": memory_mb,
        **{name: value for name, value in asdict(profile).items() if name != "rows"},
        "stages": {row.stage: {"p50_ms": row.p50_ms, "p95_ms": row.p95_ms, "share": row.share} for row in profile.rows},
    }


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
        facts = _facts(_read_text(cpuinfo))
        flags = (facts.get("flags") or facts.get("Features") or "").split()
        return cls(
            name=_read_text(board).strip("\0\n ") or facts.get("Model") or facts.get("model name") or "unknown",
            architecture=platform.machine(),
            cores=len(os.sched_getaffinity(0)),
            eight_bit=tuple(name for flag, name in INSTRUCTIONS.items() if flag in flags),
            vector=tuple(name for flag, name in OTHERS.items() if flag in flags),
            memory_mb=_total_mb(_read_text(meminfo)),
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
        mhz = [text for file in clocks.glob("cpu[0-9]*/cpufreq/scaling_cur_freq") if (text := _read_text(file).strip())]
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


def _read_text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""

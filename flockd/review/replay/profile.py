"""Where a replay's time went, on which computer, and how often that computer can step."""

from __future__ import annotations

import math
import os
import platform
import resource
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from flockd import __version__
from flockd.core.config import DroneConfig
from flockd.flight.inference import manifests_of
from flockd.ground.doctor.computer_checks import MB, MEMORY, processors_slowed
from flockd.ground.doctor.model_checks import FULL
from flockd.onboard.daemon import THERMAL_ZONES, thermal_zones
from flockd.review.replay.recorded_flight import Replay

LEAST_STEPS = 5
"""With fewer steps the slowest twentieth is a single one, and the first does not count."""
STEP = "step"
"""The row of all stages together, and what is between them."""
_ROUND_TO_S = 0.05
_LIBRARIES = ("onnxruntime", "onnxruntime-gpu", "openvino", "opencv-python-headless", "numpy")
"""Packages that decide how fast it is; one of the runtimes is installed."""
_EIGHT_BIT = {
    "amx_int8": "AMX", "avx512_vnni": "AVX-512 VNNI", "avx_vnni": "AVX-VNNI", "i8mm": "I8MM", "asimddp": "dotprod",
}  # fmt: skip
"""Instructions for 8-bit products, by the kernel's names: with none of these the 8-bit networks save little."""


@dataclass(frozen=True)
class ComputerFiles:
    """Files of the kernel that describe the computer and its present state."""

    cpuinfo: Path = Path("/proc/cpuinfo")
    board: Path = Path("/proc/device-tree/model")
    meminfo: Path = MEMORY
    thermal: Path = THERMAL_ZONES

    def computer(self) -> dict[str, Any]:
        """Board or processor, cores of this process, 8-bit instructions, and memory in MB (None: unknown)."""
        facts, total = _facts(self.cpuinfo), _facts(self.meminfo).get("MemTotal")
        flags = (facts.get("flags") or facts.get("Features") or "").split()
        board = _text(self.board).strip("\0\n ")
        return {
            "name": board or facts.get("Model") or facts.get("model name") or "unknown",
            "architecture": platform.machine(),
            "cores": len(os.sched_getaffinity(0)),
            "eight_bit": [name for flag, name in _EIGHT_BIT.items() if flag in flags],
            "memory_mb": None if total is None else int(total.split()[0]) * 1024 / MB,
        }


class Watch:
    """Notes temperatures and throttling of the computer during a replay."""

    def __init__(self, kernel: ComputerFiles | None = None) -> None:
        self.kernel = kernel or ComputerFiles()
        self._load = os.getloadavg()[0]
        self._temperatures_c: list[float] = []
        self._slowed: set[str] = set()
        self.look()

    def look(self) -> None:
        """Reads both; called once a step."""
        zones = dict(thermal_zones(self.kernel.thermal))
        self._temperatures_c += [max(zones.values())] if zones else []
        self._slowed.update(processors_slowed(self.kernel.thermal))

    def summary(self) -> dict[str, Any]:
        """As JSON: the load of the minute before the replay; temperatures in °C at the start, at most and at the end
        (None: unknown); and the names of what slowed the processor.
        """
        hot = self._temperatures_c
        return {
            "load_before": self._load,
            "temperature_c": [hot[0], max(hot), hot[-1]] if hot else None,
            "slowed_by": sorted(self._slowed),
        }


def profile_result(replay: Replay, config: DroneConfig, watch: Watch) -> dict[str, Any]:
    """As JSON: the computer, the settings that decide how long a step takes, and the time of each stage.

    The first step is left out, as it has no images before it and warms up. `least_step_s` leaves a fifth of the time
    for the other work of a drone's computer. The replay has `LEAST_STEPS` or more.
    """
    steps_ms, processor_ms = replay.steps_ms[1:], replay.processor_ms[1:]
    samples = {stage: ms[-len(steps_ms) :] for stage, ms in replay.stages_ms.items()}
    stages = {
        stage: {
            "p50_ms": float(np.median(ms)),
            "p95_ms": float(np.percentile(ms, 95)),
            "share": sum(ms) / sum(steps_ms),
        }
        for stage, ms in {**samples, STEP: steps_ms}.items()
    }
    needed_s = stages[STEP]["p95_ms"] / 1e3 / (FULL * config.safety.degraded_load)
    versions = {"flockd": __version__}
    for library in _LIBRARIES:
        with suppress(metadata.PackageNotFoundError):
            versions[library] = metadata.version(library)
    return {
        "versions": {**versions, "python": platform.python_version()},
        "computer": watch.kernel.computer(),
        "networks": [path.stem for path in manifests_of(config.perception)],
        "provider": config.perception.provider,
        "threads": config.perception.threads,
        "cameras": {camera.name: list(camera.size_px) for camera in config.rig.cameras},
        **watch.summary(),
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MB,
        "steps": len(steps_ms),
        "processor_ms": float(np.median(processor_ms)),
        "cores_busy": sum(processor_ms) / sum(steps_ms),
        "step_s": config.step_s,
        "least_step_s": round(math.ceil(needed_s / _ROUND_TO_S - 1e-9) * _ROUND_TO_S, 2),
        "stages": stages,
    }


def _facts(file: Path) -> dict[str, str]:
    """The first value of each key: all processors are taken to be alike."""
    facts: dict[str, str] = {}
    for line in _text(file).splitlines():
        key, colon, value = line.partition(":")
        if colon:
            facts.setdefault(key.strip(), value.strip())
    return facts


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""

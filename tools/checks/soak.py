"""Run a daemon for hours and measure what grows: a real `flockd run` flies a circle with a fake autopilot.

python -m tools.checks.soak --minutes 60

The first tenth of the run is the warm-up. Prints for memory, file descriptors and threads how much they grew in it,
then the mean of the next tenth and of the last, and the slope of a straight line over the rest with its 95 %
confidence interval. The line goes through the means of 20 stretches, so that neighbouring samples, which are alike, do
not count as independent. Exit code 1 if something grows by more than its allowance, all of the interval above it, or
if the daemon did not fly to the end.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from flockd.core.data import data_path
from tools.checks.px4_rows import Flight, fly

MISSION = {"kind": "circle_then_tangent", "speed_m_s": 1.0, "radius_m": 10.0, "circle_until_s": 1e9}
STRETCHES = 20
SAMPLE_S = 2
ALLOWED = {"memory, MB": 0.03, "own memory, MB": 0.03, "descriptors": 0.02, "threads": 0.02}
"""Growth over the run, as a share of the mean, that is noise."""


def slope_of(name: str, values: Sequence[float]) -> dict[str, float]:
    """Growth of a quantity, from at least 40 samples at equal intervals.

    `warm_up`: growth in the first tenth, from its first samples to its last; `first`, `last`: means of the second and
    of the last tenth; `slope` over the run without its first tenth, in the quantity's unit, and the ends `low` and
    `high` of its 95 % confidence interval; `grows`: 1 if it is more than allowed.
    """
    samples = np.asarray(values, float)
    tenth = max(len(samples) // 10, 1)
    means = np.array([stretch.mean() for stretch in np.array_split(samples[tenth:], STRETCHES)])
    line, edge = stats.linregress(np.linspace(0.0, 1.0, STRETCHES), means), max(tenth // 10, 1)
    margin = float(np.nan_to_num(stats.t.ppf(0.975, STRETCHES - 2) * line.stderr))  # NaN: the same all the time
    allowed = ALLOWED[name] * abs(float(samples.mean()))
    return {
        "warm_up": samples[tenth - edge : tenth].mean() - samples[:edge].mean(),
        "first": samples[tenth : 2 * tenth].mean(), "last": samples[-tenth:].mean(), "slope": line.slope,
        "low": line.slope - margin, "high": line.slope + margin, "grows": float(line.slope - margin > allowed),
    }  # fmt: skip


def of_the_unit() -> dict[str, str]:
    """The environment that systemd gives the daemon."""
    lines = (data_path("systemd") / "flockd.service").read_text(encoding="utf-8").splitlines()
    pairs = " ".join(line.removeprefix("Environment=") for line in lines if line.startswith("Environment="))
    return dict(pair.split("=", 1) for pair in pairs.split())


def facts_of_the_daemon() -> dict[str, float]:
    """What Linux counts of the `flockd run` that this process has started; nothing when it has ended."""
    children = [
        Path("/proc", pid) for path in Path("/proc/self/task").glob("*/children") for pid in path.read_text().split()
    ]
    folder = next((path for path in children if b"\0run\0" in (path / "cmdline").read_bytes()), None)
    if folder is None:
        return {}
    lines = (line.split() for line in (folder / "status").read_text(encoding="ascii").splitlines())
    known = {words[0].rstrip(":"): int(words[1]) / 1024 for words in lines if words[-1] == "kB"}
    return {
        "memory, MB": known["VmRSS"],
        "own memory, MB": known["RssAnon"],  # without files' pages, as of libraries first used late
        "descriptors": float(len(list((folder / "fd").iterdir()))),
        "threads": float(len(list((folder / "task").iterdir()))),
    }


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="(default: 60)")
    minutes = parser.parse_args().minutes
    samples = {name: array("d") for name in ALLOWED}  # small beside what it measures

    def sample(flown_s: int) -> None:
        if flown_s // SAMPLE_S >= len(samples["threads"]):
            for name, value in facts_of_the_daemon().items():
                samples[name].append(value)

    os.environ.update(of_the_unit())
    with tempfile.TemporaryDirectory(prefix="flockd-") as folder:
        flight = Flight("soak", MISSION, duration_s=60.0 * minutes)
        ended = fly(flight, "fake", 1.0, Path(folder), watch=sample).ended
    slopes = {name: slope_of(name, values) for name, values in samples.items()}
    print(f"{minutes:g} minutes of a daemon, {len(samples['threads'])} samples{'; ' * bool(ended)}{ended}")
    print(f"{'':20}{'warm-up':>10}{'first':>10}{'last':>10}{'growth after the warm-up, 95 %':>34}")
    for name, one in slopes.items():
        verdict = "  GROWS" if one["grows"] else ""
        interval = f"{one['slope']:+.3f} ({one['low']:+.3f} to {one['high']:+.3f})"
        print(f"{name:20}{one['warm_up']:+10.2f}{one['first']:10.2f}{one['last']:10.2f}{interval:>34}{verdict}")
    return 1 if ended or any(one["grows"] for one in slopes.values()) else 0


if __name__ == "__main__":
    sys.exit(main())

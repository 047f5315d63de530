"""Print how far the outputs of the recorded flights move on another processor, to choose tolerances by.

    python -m tools.checks.regression_spread [--networks float|recorded]

Other processors are simulated: other numbers of threads, no graph optimisation in ONNX Runtime, NumPy, OpenBLAS and
OpenCV without AVX2 and AVX-512. Each is compared with a replay as the tests do it, field by field.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import onnxruntime as ort
import yaml

from flockd.cli import main as flockd
from flockd.onboard.recording.difference import compare, load_reference
from flockd.onboard.recording.reader import Recording
from tools.checks.record_regressions import with_float_networks

HERE = Path("tests/review/replay")
FLIGHTS = ("normal", "crossing", "faults")
NO_AVX = {
    "NPY_DISABLE_CPU_FEATURES": "FMA3 AVX2 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL",
    "OPENBLAS_CORETYPE": "Nehalem",
    "OPENCV_CPU_DISABLE": "AVX,FMA3,AVX2,AVX512-SKX",
}
VARIANTS: Mapping[str, Mapping[str, str]] = {
    "as in the tests": {},
    "2 threads": {"THREADS": "2"},
    "4 threads": {"THREADS": "4"},
    "no graph optimisation": {"OPTIMISATION": "ORT_DISABLE_ALL"},
    "basic graph optimisation": {"OPTIMISATION": "ORT_ENABLE_BASIC"},
    "libraries without AVX": NO_AVX,
    "no graph optimisation, libraries without AVX": {"OPTIMISATION": "ORT_DISABLE_ALL", **NO_AVX},
}


def main() -> None:
    """Replays every flight in every variant, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--networks", choices=["float", "recorded"], default="float")
    parser.add_argument("--into", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.into is not None:
        replay_all(arguments.into, arguments.networks)
        return
    with tempfile.TemporaryDirectory() as folder:
        for number, (name, changes) in enumerate(VARIANTS.items()):
            into = Path(folder) / str(number)
            into.mkdir()
            command = [sys.executable, "-m", __spec__.name, "--networks", arguments.networks, "--into", str(into)]
            subprocess.run(command, env={**os.environ, **changes}, check=True, stdout=subprocess.DEVNULL)
            if number:
                print_spread(name, Path(folder) / "0", into)


def replay_all(into: Path, networks: str) -> None:
    """Writes a reference of each flight; this process's environment says how to compute."""
    if level := os.environ.get("OPTIMISATION"):
        _optimise_graphs(level)
    for flight in FLIGHTS:
        recording, config = HERE / f"{flight}.mcap", into / f"{flight}.yaml"
        if networks == "float":
            with_float_networks(recording, config)
        else:
            config.write_text(Recording(recording).config.model_dump_json(), encoding="utf-8")
        if threads := os.environ.get("THREADS"):
            document = yaml.safe_load(config.read_text(encoding="utf-8"))
            document["perception"]["threads"] = int(threads)
            config.write_text(yaml.safe_dump(document), encoding="utf-8")
        update = ["--config", str(config), "--reference", str(into / f"{flight}.expected"), "--update-reference"]
        if flockd(["replay", str(recording), *update]):
            raise SystemExit(f"{recording}: could not be replayed")


def _optimise_graphs(level: str) -> None:
    """Lets every session of this process open at this level."""
    opened = ort.InferenceSession

    def session(path: str, options: Any, **others: Any) -> Any:
        options.graph_optimization_level = ort.GraphOptimizationLevel.__members__[level]
        return opened(path, options, **others)

    ort.InferenceSession = session


def print_spread(name: str, expected: Path, found: Path) -> None:
    """The largest difference of each field over all flights; `other` where something else than a number differs."""
    print(f"{name}:")
    for flight in FLIGHTS:
        before, after = (load_reference(folder / f"{flight}.expected") for folder in (expected, found))
        for field, difference in sorted(compare(flight, before, after, {}).fields.items()):
            largest = "other" if difference.largest is None else f"{difference.largest:.2g}"
            print(f"  {flight}: {field}: {largest} in {len(difference.steps)} steps", flush=True)


if __name__ == "__main__":
    main()

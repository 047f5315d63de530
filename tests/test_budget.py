"""What flockd may cost: lines, files, tuned numbers, and Python calls and network runs of a step.

Each budget is what there is now. A change that removes something lowers it in the same commit; one that needs more
raises it there, and says why and what could go instead.
"""

from __future__ import annotations

import ast
import cProfile
import pstats
from pathlib import Path
from typing import Any

import onnxruntime
import pytest

from flockd.flight.pilot import FlockPilot
from flockd.onboard.recording.reader import Recording

ROOT = Path(__file__).parents[1]
LINES = {
    "flockd/core": 3_370,
    "flockd/flight": 9_580,
    "flockd/onboard": 9_250,
    "flockd/fleet": 2_710,
    "flockd/ground": 5_390,
    "flockd/review": 3_630,
    "flockd/sim": 9_080,
    "flockd/campaign": 1_490,
    "flockd/cli": 3_840,
    "tests": 39_930,
    "tools/checks": 1_710,
    "tools/docs": 1_010,
    "tools/measure": 1_530,
    "tools/release": 590,
    "tools/training": 4_330,
}
"""Lines of Python below a folder."""
FILES = {"flockd": 315}
NUMBERS_OF_FLIGHT = 199
"""In constants of the modules of `flockd/flight`."""
SLACK = 0.02
"""A budget that is farther above what there is is to be lowered."""
STEPS = {"crossing": (9_190, 16.4), "normal": (7_500, 13.8)}
"""Python calls and network runs of a step in a recorded flight of tests/review/replay."""


def _within(there_is: int, budget: int) -> None:
    assert there_is <= budget, f"{there_is} is over the budget of {budget}: what could go instead?"
    assert there_is >= (1 - SLACK) * budget, f"{there_is} is far below the budget of {budget}: lower it in this commit"


def _python(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("folder", LINES)
def test_lines(folder: str) -> None:
    _within(sum(path.read_text(encoding="utf-8").count("\n") for path in _python(folder)), LINES[folder])


@pytest.mark.parametrize("folder", FILES)
def test_files(folder: str) -> None:
    _within(len(_python(folder)), FILES[folder])


def test_tuned_numbers_of_flight() -> None:
    """Of constants with names in capitals, as they stand at the head of a module or a class."""
    numbers = 0
    for path in _python("flockd/flight"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
                continue
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
            if any(name.lstrip("_").isupper() for name in names):
                numbers += sum(
                    isinstance(part, ast.Constant) and type(part.value) in (int, float) for part in ast.walk(node.value)
                )
    _within(numbers, NUMBERS_OF_FLIGHT)


@pytest.mark.parametrize("flight", STEPS)
def test_calls_and_network_runs_of_a_step(flight: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted, as times differ from computer to computer."""
    runs: list[None] = []
    run = onnxruntime.InferenceSession.run

    def counted(self: Any, *args: Any) -> Any:
        runs.append(None)
        return run(self, *args)

    recording = Recording(ROOT / f"tests/review/replay/{flight}.mcap")
    pilot = FlockPilot(recording.config)
    steps = list(recording.steps())
    monkeypatch.setattr(onnxruntime.InferenceSession, "run", counted)
    profile = cProfile.Profile()
    for step in steps:
        profile.enable()
        pilot.step(step.frames, step.vehicle, order=step.order)
        profile.disable()
    calls = pstats.Stats(profile).total_calls  # type: ignore[attr-defined]
    most_calls, most_runs = STEPS[flight]
    _within(calls // len(steps), most_calls)
    assert len(runs) <= most_runs * len(steps)

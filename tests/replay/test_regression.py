"""Three short flights, replayed: what came out when they were made comes out today.

After a change that is meant to change it: `python tools/record_regressions.py --only references`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from flockd.cli import main
from flockd.recording.reader import Recording

HERE = Path(__file__).parent
FLIGHTS = ("normal", "crossing", "faults")
# Another processor adds up in another order: a pair of points more or less moves a motion a little, and a look more or
# less at a drone its detection by some centimetres (0.15 m at most between two processors, tracked 0.06 m).
TOLERANCES = ("velocity=0.02", "command=0.02", "neighbours=0.15", "detections=0.3", "ego_motion=0.01")
FREE = 1e9
"""Counted pairs and inliers, which that pair changes too."""
COUNTED = ("ego_motion.inliers", "ego_motion.pairs", "neighbour_motions")

Capture = pytest.CaptureFixture[str]


def against_reference(flight: str, *options: str) -> int:
    tolerances = [*TOLERANCES, *(f"{name}={FREE:g}" for name in COUNTED)]
    arguments = [part for tolerance in tolerances for part in ("--tolerance", tolerance)]
    reference = ["--diff", "--reference", str(HERE / f"{flight}.expected")]
    return main(["replay", str(HERE / f"{flight}.mcap"), *reference, *arguments, *options])


@pytest.mark.parametrize("flight", FLIGHTS)
def test_yesterdays_flight_comes_out_as_it_did(flight: str, capsys: Capture) -> None:
    code = against_reference(flight)
    assert code == 0, capsys.readouterr().out


def test_the_recordings_hold_what_they_are_named_after() -> None:
    expected = {name: steps_of(name) for name in FLIGHTS}
    confirmed = {
        name: max(sum(n["confirmed"] for n in step["neighbours"]) for step in steps) for name, steps in expected.items()
    }
    assert confirmed["normal"] >= 1
    assert confirmed["crossing"] >= 2
    reasons = " ".join(reason for step in expected["faults"] for reason in step["reasons"])
    assert "camera right: no frame" in reasons
    assert "time stamps do not increase" in reasons
    assert expected["normal"][-1]["reasons"] == []


def test_a_deliberate_change_shows_where_and_by_how_much(tmp_path: Path, capsys: Capture) -> None:
    """Neighbours are to keep twice as far away: the command changes, and what was seen does not."""
    document = json.loads(Recording(HERE / "normal.mcap").config.model_dump_json())
    document["flocking"]["desired_distance_m"] *= 2.0
    changed = tmp_path / "changed.yaml"
    changed.write_text(yaml.safe_dump(document), encoding="utf-8")
    assert against_reference("normal", "--config", str(changed)) == 1
    told = capsys.readouterr().out.splitlines()
    assert "differs at" in told[1]
    assert "in command." in told[1]
    assert "expected" in told[1]
    assert "found" in told[1]
    assert not any(line.startswith("  detections") for line in told)


def steps_of(flight: str) -> list[dict[str, Any]]:
    lines = (HERE / f"{flight}.expected").read_text(encoding="utf-8").splitlines()[1:]
    return [json.loads(line)["output"] for line in lines]

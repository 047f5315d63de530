"""Three short flights, replayed: what came out when they were made comes out today.

After a change that is meant to change it: `python -m tools.checks.record_regressions --only references`. Recordings
stay as they are. They are replayed with the networks in 32-bit floats, whose outputs differ little between processors.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from flockd.cli import main
from tools.checks.record_regressions import with_float_networks

HERE = Path(__file__).parent
FLIGHTS = ("normal", "crossing", "faults")
# Another processor adds up in another order. `python -m tools.checks.regression_spread` simulates some: ONNX Runtime
# without graph optimisation, libraries without AVX. The largest differences in `normal` and `crossing` were 3e-6 in
# velocity, 0.001 in command, 0.0093 in neighbours, 0.0008 in detections and 1.3e-6 in ego_motion; in `faults`, whose
# torn and black images leave a detection close to a threshold, 0.0003, 0.0054, 0.052, 0.0073 and 0.00016. Tolerances
# lie above by factors of 1.6 to 77. Units are m, rad and s; a detection's log range is the logarithm of metres.
TOLERANCES = ("velocity=1e-4", "command=0.002", "neighbours=0.015", "detections=0.003", "ego_motion=1e-4")
TOLERANCES_OF = {
    "faults": ("velocity=0.001", "command=0.015", "neighbours=0.12", "detections=0.02", "ego_motion=0.001"),
}
FREE = 1e9
"""Counted pairs and inliers, which that pair changes too."""
COUNTED = ("ego_motion.inliers", "ego_motion.pairs", "neighbour_motions")

Capture = pytest.CaptureFixture[str]


def against_reference(flight: str, config: Path) -> int:
    tolerances = [*TOLERANCES_OF.get(flight, TOLERANCES), *(f"{name}={FREE:g}" for name in COUNTED)]
    arguments = [part for tolerance in tolerances for part in ("--tolerance", tolerance)]
    reference = ["--diff", "--reference", str(HERE / f"{flight}.expected")]
    return main(["replay", str(HERE / f"{flight}.mcap"), "--config", str(config), *reference, *arguments])


@pytest.mark.parametrize("flight", FLIGHTS)
def test_yesterdays_flight_comes_out_as_it_did(flight: str, tmp_path: Path, capsys: Capture) -> None:
    code = against_reference(flight, with_float_networks(HERE / f"{flight}.mcap", tmp_path / "drone.yaml"))
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
    changed = with_float_networks(HERE / "normal.mcap", tmp_path / "changed.yaml")
    document = yaml.safe_load(changed.read_text(encoding="utf-8"))
    document["flocking"]["desired_distance_m"] *= 2.0
    changed.write_text(yaml.safe_dump(document), encoding="utf-8")
    assert against_reference("normal", changed) == 1
    told = capsys.readouterr().out.splitlines()
    assert "differs at" in told[1]
    assert "in command." in told[1]
    assert "expected" in told[1]
    assert "found" in told[1]
    assert not any(line.startswith("  detections") for line in told)


def steps_of(flight: str) -> list[dict[str, Any]]:
    lines = (HERE / f"{flight}.expected").read_text(encoding="utf-8").splitlines()[1:]
    return [json.loads(line)["output"] for line in lines]

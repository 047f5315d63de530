"""Four short flights, replayed: what came out when they were made comes out today.

After a change that is meant to change it: `python -m tools.checks.references`. Recordings
stay as they are. They are replayed with the networks in 32-bit floats, whose outputs differ little between processors.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flockd.cli import main
from flockd.core.messages import PilotOutput
from flockd.flight.pilot import FlockPilot
from flockd.onboard.daemon import load_side_by_side
from flockd.onboard.message_json import from_json
from flockd.onboard.recording.reader import Recording
from tools.checks.references import FLIGHTS, with_float_networks

HERE = Path(__file__).parent
LIKE_ANOTHER_PROCESSOR = {
    "normal": "command=0.003 neighbours=0.045 detections=0.03 detections.drone_probability=0.09",
    "crossing": "command=0.1 neighbours=0.7 detections=1.1",
    "fisheye": "command=0.05 neighbours=0.3 detections=0.15",
    "faults": "command=0.15 neighbours=1.5 detections=0.3",
}
"""Tolerances: twice the largest differences among 15 replays in which each number that a network gave was wrong by 3e-6
of itself and of their standard deviation, as on a processor that adds up in another order. Where the networks hardly
see a drone that moves a crop, and the crop the range; so only `normal` shows small changes. In m, rad and s."""
OF_ALL = "velocity=1e-3 ego_motion=1e-3 ego_motion.pairs=100 ego_motion.inliers=100 seen_m=1e-3 mission=1e-9"

Capture = pytest.CaptureFixture[str]


def tolerances(flight: str) -> list[str]:
    """Options of `flockd replay`; `tools.release.check_emulated` gives them too."""
    found = f"{LIKE_ANOTHER_PROCESSOR[flight]} {OF_ALL}".split()
    return [f"--tolerance={tolerance}" for tolerance in found]


def against_reference(flight: str, config: Path, expected: Path | None = None) -> int:
    reference = ["--diff", "--reference", str(expected or HERE / f"{flight}.expected")]
    return main(["replay", str(HERE / f"{flight}.mcap"), "--config", str(config), *reference, *tolerances(flight)])


@pytest.mark.parametrize("flight", FLIGHTS)
def test_yesterdays_flight_comes_out_as_it_did(flight: str, tmp_path: Path, capsys: Capture) -> None:
    code = against_reference(flight, with_float_networks(HERE / f"{flight}.mcap", tmp_path / "drone.yaml"))
    assert code == 0, capsys.readouterr().out


@pytest.mark.parametrize("flight", FLIGHTS)
def test_no_neighbour_is_confirmed_or_lost_more_than_a_step_later_for_cameras_that_jitter(flight: str) -> None:
    as_flown, found = confirmed_by_step(flight, jitter_s=0.0), confirmed_by_step(flight, jitter_s=1e-3)
    around = [as_flown[max(step - 1, 0) : step + 2] for step in range(len(as_flown))]
    assert all(min(flown) <= one <= max(flown) for one, flown in zip(found, around, strict=True))


def confirmed_by_step(flight: str, jitter_s: float) -> list[int]:
    """How many neighbours each step has, the frames' times off by some standard deviation."""
    recording, random = Recording(HERE / f"{flight}.mcap"), np.random.default_rng(0)
    pilot, counts = FlockPilot(recording.config, load_side_by_side(recording.config)), list[int]()
    for step in recording.steps():
        off_s = jitter_s * random.normal()
        cameras = {name: replace(one, time_s=one.time_s + off_s) for name, one in step.frames.frames.items()}
        frames = replace(step.frames, time_s=step.frames.time_s + off_s, frames=cameras)
        output = pilot.step(frames, step.vehicle, None, step.order)
        counts.append(sum(one.confirmed for one in output.neighbours))
    return counts


def test_the_recordings_hold_what_they_are_named_after() -> None:
    expected = {name: steps_of(name) for name in FLIGHTS}
    confirmed = {
        name: max(sum(n["confirmed"] for n in step["neighbours"]) for step in steps) for name, steps in expected.items()
    }
    assert confirmed["normal"] >= 1
    assert confirmed["crossing"] >= 2
    assert confirmed["fisheye"] >= 1
    assert {camera.intrinsics.model for camera in Recording(HERE / "fisheye.mcap").config.rig.cameras} == {"wide_angle"}
    reasons = " ".join(reason for step in expected["faults"] for reason in step["reasons"])
    assert "camera right: no frame" in reasons
    assert "time stamps do not increase" in reasons
    assert expected["normal"][-1]["reasons"] == []


def test_outputs_of_an_older_version_are_read_without_what_is_gone() -> None:
    *_, last = Recording(HERE / "normal.mcap").steps()
    assert last.output is not None and "rig" in last.output
    output: PilotOutput = from_json(PilotOutput, last.output)
    assert output.time_s == last.frames.time_s


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

"""`flockd replay`: the flight again, and a readable word on whatever comes out differently."""

from __future__ import annotations

import json
import re
from contextlib import ExitStack
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from flockd.cli import main
from flockd.core.config import Overrides
from flockd.core.data import data_path
from flockd.core.messages import FrameSet, PilotOutput, Reason, ReasonKind
from flockd.flight.inference.manifest_file import model_hashes
from flockd.onboard.recording import Recorder
from flockd.onboard.recording.reader import Recording
from flockd.review.flight_log.from_recordings import flight_log, recordings_in
from flockd.review.flight_log.log import FlightLog
from flockd.sim.flock.start import with_drones
from flockd.sim.flock.swarm import fly
from flockd.sim.scenario import ScenarioConfig, load_scenario
from tests.conftest import Told
from tests.make import small_eyes
from tests.onboard.recording.made_up import MODELS, MadeUpPilot, drone_config, record

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recorded flight of the made-up pilot, which will also be the one to fly it again."""
    monkeypatch.setattr("flockd.review.replay.recorded_flight.FlockPilot", MadeUpPilot)
    monkeypatch.setattr("flockd.review.replay.recorded_flight.model_hashes", lambda perception: MODELS)
    path = tmp_path / "drone1.mcap"
    record(path)
    return path


class Nudged(MadeUpPilot):
    """Turns a little more from the fourth step on."""

    def step(self, frames: FrameSet, *more: Any, **order: Any) -> PilotOutput:
        output = super().step(frames, *more, **order)
        if frames.time_s > 1000.25:
            output.command.velocity[1] += 1e-9
        return output


@pytest.fixture
def nudged(path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("flockd.review.replay.recorded_flight.FlockPilot", Nudged)
    return path


def test_a_replay_equals_the_flight(path: Path, told: Told) -> None:
    first, second = told(0, "replay", path, "--diff").splitlines()
    assert first.startswith("drone1: 10 steps, 0.9 s, ")
    assert second.startswith("equal in all ")
    result = json.loads(told(0, "replay", path, "--diff", "--json"))
    assert (result["steps"], result["diff"]["equal"], result["warnings"]) == (10, True, [])


def test_a_replay_that_can_use_no_image_fails(path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    class Refusing(MadeUpPilot):
        def step(self, *inputs: Any, **order: Any) -> PilotOutput:
            refused = (Reason(ReasonKind.INPUT, "input refused: the attitude is not a rotation"),)
            return replace(super().step(*inputs, **order), reasons=refused)

    monkeypatch.setattr("flockd.review.replay.recorded_flight.FlockPilot", Refusing)
    assert main(["replay", str(path)]) == 1
    told = f"{path}: no image could be used: input refused: the attitude is not a rotation\n"
    assert capsys.readouterr().err == told


def test_the_first_difference_is_told_with_time_drone_field_and_both_values(nudged: Path, capsys: Capture) -> None:
    assert main(["replay", str(nudged), "--diff"]) == 1
    told = capsys.readouterr().out.splitlines()
    recorded = next(step.output for step in Recording(nudged).steps() if step.number == 3)
    assert recorded is not None
    value = recorded["command"]["velocity"][1]
    for part in ("1000.300 s (step 3)", "command.velocity[1]", f"{value!r}", f"{value + 1e-9!r}"):
        assert part in told[1]
    assert re.search(r"command\.velocity: .* 7 of 10 .* 1e-09$", told[2])
    assert main(["replay", str(nudged), "--diff", "--json"]) == 1
    first = json.loads(capsys.readouterr().out)["diff"]["first"]
    assert first["field"] == "command.velocity[1]"
    assert (first["expected"], first["found"]) == (value, value + 1e-9)


def test_tolerances_are_for_a_field_and_what_is_in_it(nudged: Path, capsys: Capture) -> None:
    for tolerance, code in (("command=2e-9", 0), ("command.velocity=2e-9", 0), ("command.yaw_rad=1", 1)):
        assert main(["replay", str(nudged), "--diff", "--tolerance", tolerance]) == code
    narrow = ["--tolerance", "command=1", "--tolerance", "command.velocity=1e-12"]
    assert main(["replay", str(nudged), "--diff", *narrow]) == 1, "the longer name counts"
    assert "no output has this field" not in capsys.readouterr().err
    assert main(["replay", str(nudged), "--diff", "--tolerance", "command=1", "--tolerance", "comand.velocity=1"]) == 0
    assert "--tolerance comand.velocity: no output has this field, so nothing was permitted" in capsys.readouterr().err


def test_a_reference_is_written_compared_and_updated(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    reference = path.with_name("drone1.expected")
    against = ["replay", str(path), "--diff", "--reference", str(reference)]
    update = ["replay", str(path), "--reference", str(reference), "--update-reference"]
    assert main(against) == 2
    assert capsys.readouterr().err.startswith(f"{reference}: does not exist; ")
    assert main(update) == 0
    assert main(against) == 0
    assert main([*against, "--start", "0.4"]) == 1, "a pilot that begins in the middle remembers nothing"
    monkeypatch.setattr("flockd.review.replay.recorded_flight.FlockPilot", Nudged)
    capsys.readouterr()
    assert main(against) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.endswith(f" flockd replay {path} --reference {reference} --update-reference")
    assert main(update) == 0
    assert main(against) == 0

    reference.write_text(reference.read_text(encoding="utf-8")[:-400], encoding="utf-8")
    capsys.readouterr()
    assert main(against) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"{reference}: is ")
    assert error.count("\n") == 1


def test_a_new_recording_is_a_flight_too(nudged: Path, capsys: Capture) -> None:
    out = nudged.with_name("again.mcap")
    assert main(["replay", str(nudged), "--out", str(out)]) == 0
    assert main(["replay", str(out), "--diff"]) == 0
    assert Recording(out).contents.flight["replayed_from"] == "drone1.mcap"
    assert main(["replay", str(nudged), "--out", str(out)]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"{out}: exists; ")


def test_a_replay_that_breaks_off_leaves_no_recording(path: Path, monkeypatch: pytest.MonkeyPatch, told: Told) -> None:
    class Broken(MadeUpPilot):
        def step(self, *_: object, **__: object) -> PilotOutput:
            raise KeyboardInterrupt

    monkeypatch.setattr("flockd.review.replay.recorded_flight.FlockPilot", Broken)
    assert told(130, "replay", path, "--out", path.with_name("again.mcap")) == "interrupted\n"
    assert [file.name for file in path.parent.iterdir()] == ["drone1.mcap"]


def test_other_settings_can_be_tried(path: Path, told: Told) -> None:
    values = drone_config().model_dump(mode="json")
    values["flocking"]["cohesion"] = 0.2
    file = path.with_name("other.yaml")
    file.write_text(yaml.safe_dump(values), encoding="utf-8")
    assert main(["replay", str(path), "--config", str(file), "--diff"]) == 1
    values["rig"]["cameras"][1]["size_px"] = [164, 124]
    file.write_text(yaml.safe_dump(values), encoding="utf-8")
    error = told(2, "replay", path, "--config", file)
    assert error.startswith(f"{file}: rig.cameras: camera 'left' has 164 x 124 pixels, but {path} ")


def test_a_flights_folder_names_its_recordings(path: Path, told: Told) -> None:
    told_of = told(1, "replay", path.parent, "--diff")
    assert told_of.startswith(f"{path.parent}: is a folder of recordings; name one, as in `flockd replay {path}`")


def test_a_reference_takes_no_other_files_place(path: Path, told: Told) -> None:
    recording = path.read_bytes()
    refused = told(2, "replay", path, "--reference", path, "--update-reference")
    assert refused == f"{path}: exists; name another file\n"
    assert path.read_bytes() == recording


def test_what_keeps_a_replay_from_being_the_flight_is_told(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr("flockd.review.replay.recorded_flight.model_hashes", lambda perception: {"flow": "cd" * 32})
    killed = path.with_name("killed.mcap")
    killed.write_bytes(path.read_bytes()[:-200_000])
    assert main(["replay", str(killed), "--diff"]) == 0
    cut_off, models = capsys.readouterr().err.splitlines()
    assert cut_off.startswith(f"{killed}: ends early at byte ")
    assert models.startswith("model flow is cdcdcdcdcdcd here")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--update-reference"], "--update-reference needs"),
        (["--reference", "x"], "--reference alone"),
        (["--tolerance", "command=1"], "--tolerance has no meaning without --diff"),
        (["--out", "again"], "again: a recording is written as .mcap; give it such a name"),
        (["--reference", "x", "--diff", "--update-reference"], "--diff and --update-reference exclude each other"),
        (["--vehicle", "/odom"], "--vehicle is for bags"),
        (["--depth", "recorded"], "--depth is for datasets"),
    ],
)
def test_options_that_make_no_sense_together(path: Path, options: list[str], says: str, told: Told) -> None:
    assert told(2, "replay", path, *options).startswith(says)


# From pixels: two drones through the simulator, with the shipped networks and small cameras.
DRONES = ("drone1", "drone2")


def scenario(overrides: Overrides) -> ScenarioConfig:
    paper = load_scenario(data_path("config") / "paper_flight.yaml", {"duration_s": 2.5, **overrides})
    return small_eyes(with_drones(paper, 2))


class Flight(NamedTuple):
    folder: Path
    """Of its recordings."""
    log: FlightLog


@pytest.fixture(
    scope="module", params=["dis", pytest.param("flow", marks=[pytest.mark.slow, pytest.mark.whole_flight])]
)
def flight(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    flown, folder = scenario({"drone.perception.flow": request.param}), tmp_path_factory.mktemp("flight")
    models = model_hashes(flown.drone.perception)
    with ExitStack() as stack:
        recorders = [
            stack.enter_context(Recorder(folder / f"{drone}.mcap", drone=drone, config=flown.drone, models=models))
            for drone in DRONES
        ]
        return Flight(folder, fly(flown, recorders=recorders, threads=0).log)


def test_a_replay_of_a_simulated_flight_equals_it_bit_for_bit(flight: Flight, told: Told) -> None:
    for index, drone in enumerate(DRONES):
        path = flight.folder / f"{drone}.mcap"
        result = json.loads(told(0, "replay", path, "--diff", "--json"))
        assert (result["steps"], result["diff"]["equal"], result["warnings"]) == (5, True, [])
        assert result["diff"]["values"] > 5 * 20, "own motion, velocity and command alone are as many"
        for step in Recording(path).steps():
            assert step.output is not None
            assert step.output["command"]["velocity"] == flight.log.command_velocity[step.number, index].tolist()


@pytest.mark.parametrize("flight", ["dis"], indirect=True)
def test_the_recordings_make_the_flights_own_log(flight: Flight) -> None:
    """What the drones recorded is all that the report needs: to the last bit, with the truth and its companion."""
    again = flight_log([Recording(path) for path in recordings_in(flight.folder)])
    for part in fields(FlightLog):
        if part.name not in ("stages_ms", "metadata"):
            assert getattr(again, part.name).tobytes() == getattr(flight.log, part.name).tobytes(), part.name
    facts = ("drones", "duration_s", "step_s", "perception", "flow", "scale", "circle_until_s", "desired_distance_m")
    assert again.metadata.model_dump(include=set(facts)) == flight.log.metadata.model_dump(include=set(facts))


def test_where_time_goes_and_which_step_to_configure(path: Path, monkeypatch: pytest.MonkeyPatch, told: Told) -> None:
    """Ten steps of a made-up flight: the first, which warms up, takes 9 s, the others 120 to 160 ms."""
    took_s = iter([9.0, 0.12, 0.12, 0.12, 0.12, 0.14, 0.14, 0.14, 0.16, 0.16])

    class Timed(MadeUpPilot):
        def step(self, *frames: Any, **order: Any) -> PilotOutput:
            whole_s = next(took_s)
            clock[0] += whole_s
            output = super().step(*frames, **order)
            return replace(output, stages_ms={"flow": 750.0 * whole_s, "detection": 250.0 * whole_s})

    clock = [0.0]
    monkeypatch.setattr("flockd.review.replay.recorded_flight.FlockPilot", Timed)
    monkeypatch.setattr("flockd.review.replay.recorded_flight.time.perf_counter", lambda: clock[0])
    monkeypatch.setattr("flockd.review.replay.recorded_flight.time.process_time", lambda: 1.5 * clock[0])
    profile = json.loads(told(0, "replay", path, "--profile", "--json"))["profile"]
    assert list(profile["stages"]) == ["flow", "detection", "step"]
    step, flow = profile["stages"]["step"], profile["stages"]["flow"]
    assert (step["p50_ms"], step["p95_ms"]) == pytest.approx((140.0, 160.0))
    assert (flow["p50_ms"], flow["p95_ms"], flow["share"]) == pytest.approx((105.0, 120.0, 0.75))
    assert (profile["steps"], profile["cores_busy"]) == (9, pytest.approx(1.5))
    assert profile["processor_ms"] == pytest.approx(210.0)
    assert (profile["step_s"], profile["least_step_s"]) == (0.5, 0.2), "160 ms are four fifths of it"
    assert profile["memory_mb"] > 10
    assert profile["cameras"] == {"front": [160, 120], "left": [160, 120]}


def test_the_table_of_where_time_goes(path: Path, told: Told) -> None:
    table = told(0, "replay", path, "--profile")
    for part in ("stage ", "p50 ms", "step  ", "computer:", "memory_mb: ", "step_s 0.5 is configured"):
        assert part in table
    assert "--profile" in told(2, "replay", path, "--profile", "--end", "0.2")

"""What a person at a terminal gets: help with examples, one sentence for a slip, and exit codes for scripts."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from flockd import __version__
from flockd.cli import _parser, installing, main
from flockd.core.errors import ModelError

ROOT = Path(__file__).parents[2]
PAPER_FLIGHT = (ROOT / "config" / "paper_flight.yaml").read_text(encoding="utf-8")
SIMULATOR = (ROOT / "config" / "simulator.yaml").read_text(encoding="utf-8")


def commands(parser: argparse.ArgumentParser) -> Iterator[list[str]]:
    """The words of each command and group of commands."""
    yield parser.prog.split()[1:]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                if name != getattr(parser, "default_command", None):  # its examples leave the word out
                    yield from commands(inner)


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """The paper's flight in a folder of its own, to be spoilt."""
    (tmp_path / "simulator.yaml").write_text(SIMULATOR, encoding="utf-8")
    path = tmp_path / "flight.yaml"
    path.write_text(PAPER_FLIGHT, encoding="utf-8")
    return path


def _usage_error(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    return captured.err


@pytest.mark.parametrize("command", list(commands(_parser())), ids=" ".join)
def test_help_shows_examples_of_the_command(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main([*command, "--help"])
    assert exit_.value.code == 0
    examples = capsys.readouterr().out.split("examples:\n")[1].split("\n\n")[0].splitlines()
    assert examples
    assert all(" ".join(["flockd", *command]) in example for example in examples)


def test_help_needs_nothing_but_python() -> None:
    """Only rich is loaded of what is installed before a command runs."""
    heavy = {"numpy", "pydantic", "yaml", "cv2", "onnxruntime", "zenoh", "numba", "matplotlib", "jinja2"}
    code = f"import sys, flockd.cli; print(*{heavy!r} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == ""


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(["--version"])
    assert exit_.value.code == 0
    package = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert package["project"]["dynamic"] == ["version"], "it stands in flockd/__init__.py alone"
    assert capsys.readouterr().out == f"flockd {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["sims"], "flockd: 'sims' is not a command; did you mean `flockd sim`?; see flockd --help"),
        (["status", "--once"], "flockd status: unknown argument --once; see flockd status --help"),
        (
            ["calibrate", "camera", "--once", "2"],
            "flockd calibrate camera: unknown argument --once; see flockd calibrate camera",
        ),
        (["record", "xyz"], "flockd record: 'xyz' is not a command, of info, recover, cut, export; see "),
        (["fleet", "--port", "99999"], "flockd fleet: argument --port: '99999' is not a port"),
        (["fleet", "--listen", "tcp/0.0.0.0:7447"], "flockd fleet: argument --listen: 'tcp/0.0.0.0:7447' is not an IP"),
        (["replay", "x.mcap", "--start", "-1"], "flockd replay: argument --start: '-1' is not a number, 0 or more"),
        (["replay", "x.mcap", "--tolerance", "command"], "flockd replay: argument --tolerance: 'command' is not"),
        (["replay", "x.mcap", "--tolerance", "command=-1"], "flockd replay: argument --tolerance: 'command=-1' is not"),
        (["sim", "--set", "seed"], "flockd sim: argument --set: 'seed' is not a key and its value"),
        (["sim", "--duration", "-3"], "flockd sim: argument --duration: '-3' is not a positive number"),
        (["sim", "--duration", "nan"], "flockd sim: argument --duration: 'nan' is not a positive number"),
        (["sim", "--drones", "0"], "flockd sim: argument --drones: '0' is not a positive whole number"),
        (["sim", "--drones", "5000"], "flockd sim: argument --drones: '5000' is more than the 100 drones"),
        (["sim", "--drones", "2.5"], "flockd sim: argument --drones: '2.5' is not a positive whole number"),
        (["sim", "--seed", "-1"], "flockd sim: argument --seed: '-1' is not a whole number, 0 or more"),
        (["sim", "--seed", "9" * 5000], f"flockd sim: argument --seed: '{'9' * 5000}' is not a whole number"),
        (
            ["sim", "--swap", "flow,eyes"],
            "flockd sim: argument --swap: 'eyes' is not a role; the roles are flow, depth",
        ),
    ],
)
def test_a_slip_on_the_command_line_is_a_usage_error(
    arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    error = _usage_error(capsys, *arguments)
    assert error.startswith(told)
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["fleet", "--fleet", "other", "hold", "drone2"],
        ["fleet", "--connect=tcp/127.0.0.1:1", "hold", "drone2"],
        ["fleet", "--watch-only", "goto", "all", "1", "1"],
        ["ros", "--drones-at", "tcp/127.0.0.1:1", "perceive", "--config", "drone.yaml"],
    ],
    ids=" ".join,
)
def test_an_option_before_a_command_is_refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """`flockd fleet --fleet other hold drone2` went to every fleet: the command's default replaced it."""
    assert f"{arguments[1]} stands before the command " in _usage_error(capsys, *arguments)


@pytest.mark.parametrize("command", [[], ["record"], ["config"], ["calibrate"]], ids=" ".join)
def test_without_a_command_the_help_is_shown(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(" ".join(["usage: flockd", *command]))
    assert "examples:\n" in captured.err


@pytest.mark.parametrize(
    "option",
    [["--set", "drone.perception.flow=dis"], ["--set", "cameras.preset=realistic"], ["--swap", "flow"], ["--record"]],
)
def test_options_of_sight_are_refused_without_sight(option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "--perception", "truth", *option]) == 2
    given = " ".join(option).partition("=")[0] if option[0] == "--set" else option[0]
    assert capsys.readouterr().err.startswith(f"{given} has no meaning without networks; ")


@pytest.mark.parametrize("command", [["config", "check"], ["config", "show"], ["sim"]], ids=" ".join)
def test_a_wrong_scenario_is_told_in_one_sentence(
    scenario: Path, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """`tests/core/config` has the sentences for all slips."""
    scenario.write_text(PAPER_FLIGHT.replace("duration_s:", "duration:"), encoding="utf-8")
    assert main([*command, str(scenario)]) == 78
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"{scenario}:3: duration: ")
    assert captured.err.count("\n") == 1


def test_a_flight_shorter_than_a_step_is_refused(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", str(scenario), "--duration", "0.1"]) == 78
    assert capsys.readouterr().err.startswith("--duration: 0.1 s is shorter than a step of 0.5 s; ")


def test_config_check_finds_models_that_are_not_there(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drone = scenario.with_name("simulator.yaml")
    drone.write_text(SIMULATOR.replace("flow: flow_int8", "flow: flow_in8"), encoding="utf-8")
    assert main(["config", "check", str(scenario)]) == 78
    error = capsys.readouterr().err
    assert error.startswith(f"{drone}:23: perception.flow: flow_in8 ")
    assert error.endswith("write one of flow, flow_int8, dis\n")
    drone.write_text(SIMULATOR.replace("flow: flow_int8", "flow: distance_int8"), encoding="utf-8")
    assert main(["config", "check", str(drone)]) == 78
    assert capsys.readouterr().err.startswith(f"{drone}:23: perception.flow: distance_int8 is for distance, not for ")


def test_config_check_reports_for_people_and_machines(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drone = scenario.with_name("simulator.yaml")
    assert main(["config", "check", str(scenario), str(drone)]) == 0
    assert capsys.readouterr().out == f"{scenario}: fine\n{drone}: fine\n"
    assert main(["config", "check", "--json", str(scenario)]) == 0
    assert json.loads(capsys.readouterr().out) == {"ok": True, "problems": []}

    drone.write_text(SIMULATOR.replace("yaw: course", "yaw: corse"), encoding="utf-8")
    assert main(["config", "check", "--json", str(scenario), str(drone)]) == 78
    told = json.loads(capsys.readouterr().out)
    (problem,) = told["problems"]
    assert not told["ok"]
    assert problem.pop("message")
    assert problem == {"file": str(drone), "line": 33, "key": "yaw"}, "of a file named twice it is told once"


def test_every_shipped_configuration_is_fine() -> None:
    files = [str(path) for path in (ROOT / "config").glob("*.yaml")]
    assert main(["config", "check", *files]) == 0


@pytest.mark.parametrize("name", ["simulator.yaml", "flight.yaml"])
def test_config_show_fills_in_the_defaults_and_can_be_loaded_again(
    scenario: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = scenario.with_name(name)
    assert main(["config", "show", "--json", str(file)]) == 0
    values = json.loads(capsys.readouterr().out)
    drone = values.get("drone", values)
    assert drone["flocking"]["desired_distance_m"] == 3.5, "the paper's D_d, which the file leaves out"
    assert main(["config", "show", str(file)]) == 0
    file.write_text(capsys.readouterr().out, encoding="utf-8")
    assert main(["config", "check", str(file)]) == 0
    capsys.readouterr()
    assert main(["config", "show", "--json", str(file)]) == 0
    assert json.loads(capsys.readouterr().out) == values


@pytest.mark.parametrize("kind", ["drone", "scenario", "campaign"])
def test_config_schema_is_json(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "schema", kind]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert schema["type"] == "object"
    assert schema["additionalProperties"] is False


def test_a_folder_with_other_files_is_not_flown_into(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis.txt").write_text("the only copy", encoding="utf-8")
    assert main(["sim", "--duration", "1", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f"{tmp_path}: holds other files than a flight's; ")
    assert main(["sim", "--duration", "1", "--out", str(tmp_path / "thesis.txt")]) == 2
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'thesis.txt'}: is a file; ")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_report_of_no_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f"{tmp_path}: holds neither a flight's flight.npz nor recordings; ")


def test_a_report_of_a_damaged_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "flight.npz"
    for content in (b"", b"PK\x03\x04 cut off", b"something else"):
        log.write_bytes(content)
        assert main(["report", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"{log}: is not a whole flight log (")
        assert error.count("\n") == 1


def test_a_shell_completes_commands_and_options() -> None:
    """As argcomplete's script for bash asks: by environment, with the answer on file descriptor 8."""
    for line, expected in (("flockd rep", {"report", "replay"}), ("flockd sim --pe", {"--perception"})):
        code = "import os, sys; from flockd.cli import main; os.dup2(1, 8); sys.argv[0] = 'flockd'; main()"
        environment = {
            **os.environ,
            "_ARGCOMPLETE": "1",
            "COMP_LINE": line,
            "COMP_POINT": str(len(line)),
            "_ARGCOMPLETE_IFS": "\n",
        }
        told = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
        )
        assert {word.strip() for word in told.stdout.splitlines()} == expected, told.stderr


@pytest.mark.parametrize(
    ("error", "code", "told"),
    [
        (ModuleNotFoundError("", name="numba"), 69, f"numba is not installed; run: {installing('sim')}"),
        (
            ModelError("models/flow.yaml: sha256: differs; restore it"),
            78,
            "models/flow.yaml: sha256: differs; restore it",
        ),
    ],
    ids=["a missing extra", "a damaged model"],
)
def test_what_a_flight_lacks_is_one_sentence(
    error: Exception, code: int, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(_: object) -> int:
        raise error

    monkeypatch.setattr("flockd.cli.sim._scenario", fails)
    assert main(["sim"]) == code
    assert capsys.readouterr().err == f"{told}\n"


def test_an_extra_is_added_to_a_checkout_without_freezing_it() -> None:
    checkout = Path(__file__).parents[2]
    assert installing("view") == f"{sys.executable} -m pip install -e '{checkout}[view]'"


def test_models_in_an_empty_folder_are_unavailable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("list", "verify"):
        assert main(["models", command, "--dir", str(tmp_path)]) == 69
        assert capsys.readouterr().err.startswith(f"{tmp_path} holds no model manifests; ")


def test_verifying_a_damaged_model_fails_the_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "flow.yaml").write_text("name: flow\n", encoding="utf-8")
    assert main(["models", "verify", "--json", "--dir", str(tmp_path)]) == 1
    (told,) = json.loads(capsys.readouterr().out)
    assert (told["model"], told["ok"]) == ("flow", False)
    assert told["fault"].startswith(f"{tmp_path / 'flow.yaml'}:1: accuracy: is missing; add it with a section")
    assert main(["models", "list", "--dir", str(tmp_path)]) == 78


def test_a_flight_leaves_its_log_summary_and_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "flight"
    short = ["sim", "--perception", "truth", "--duration", "5", "--drones", "3", "--seed", "3", "--out", str(folder)]
    assert main([*short, "--json"]) == 0
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    assert (summary["drones"], summary["duration_s"], summary["seed"]) == (3, 5.0, 3)
    assert {"flight.npz", "summary.json", "report.html"} <= {path.name for path in folder.iterdir()}
    assert json.loads((folder / "summary.json").read_text(encoding="utf-8")) == summary

    (folder / "summary.json").unlink()
    (folder / "report.html").unlink()
    assert main(["report", str(folder)]) == 0
    told = capsys.readouterr().out
    assert f"{summary['flock']['min_distance_m']:.2f} m" in told
    assert told.splitlines()[-1] == f"report: {folder / 'report.html'}"
    assert json.loads((folder / "summary.json").read_text(encoding="utf-8")) == summary
    assert (folder / "report.html").is_file()

    assert main(short) == 2
    assert capsys.readouterr().err.startswith(f"{folder}: holds a flight; ")
    (folder / "recordings").mkdir()
    (folder / "recordings" / "drone1.mcap").touch()
    monkeypatch.setattr("flockd.review.report.flight_folder.write_report", lambda folder, *_: folder)
    assert main([*short, "--quiet", "--force"]) == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == (f"{folder / 'report.html'}\n", "")
    assert not (folder / "recordings").exists(), "nothing of the flight before is left beside the new one"


def test_each_flight_has_its_own_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flockd.review.report.flight_folder.write_report", lambda folder, *_: folder)
    short = ["sim", "--perception", "truth", "--duration", "2", "--quiet"]
    for expected in ("", "-2", "-3"):
        assert main(short) == 0
        assert capsys.readouterr().out == f"out/paper_flight-truth-duration_2-seed0{expected}/report.html\n"
    windy = [*short, "--set", "vehicle.wind_m_s=[3,-1.5]", "--drones", "3", "--no-gate", "--duration", "3"]
    assert main(windy) == 0
    folder = "out/paper_flight-truth-duration_3-drones_3-wind_m_s_3,-1.5-no-gate-seed0"
    assert capsys.readouterr().out == f"{folder}/report.html\n"


def test_an_interrupted_flight_leaves_its_report_and_can_be_flown_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from flockd.review.flight_log.log import FlightLog
    from flockd.sim.vehicles.vehicles import Vehicles

    step, steps = Vehicles.step, iter(range(1000))

    def interrupted(vehicles: Vehicles, *arguments: object) -> None:
        if next(steps) == 70:  # ten setpoints a step
            raise KeyboardInterrupt
        step(vehicles, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Vehicles, "step", interrupted)
    monkeypatch.setattr("flockd.review.report.flight_folder.write_report", lambda folder, *_: folder)
    folder = tmp_path / "flight"
    command = ["sim", "--perception", "truth", "--duration", "20", "--quiet", "--out", str(folder)]
    assert main(command) == 130
    captured = capsys.readouterr()
    assert captured.out == f"{folder / 'report.html'}\n"
    assert captured.err.startswith("interrupted after 3.5 s of 20 s; ")
    log = FlightLog.load(folder / "flight.npz")
    assert (len(log.time_s), log.metadata.duration_s, log.metadata.interrupted) == (7, 3.5, True)
    assert log.truth_position.shape == (7, 5, 3)

    monkeypatch.setattr(Vehicles, "step", step)
    assert main(command) == 0, "the same command works again"
    moved = tmp_path / "flight-interrupted"
    assert f"{moved}" in capsys.readouterr().err
    assert FlightLog.load(moved / "flight.npz").metadata.interrupted
    assert not FlightLog.load(folder / "flight.npz").metadata.interrupted


def test_what_is_set_is_what_is_flown() -> None:
    from flockd.cli.sim import _scenario

    words = [
        "--set",
        "vehicle.wind_m_s=[2, -1.5]",
        "--set",
        "drone.mission={kind: circle_then_tangent, radius_m: 15.0}",
    ]
    scenario = _scenario(_parser().parse_args(["sim", *words]))
    assert (scenario.vehicle.wind_m_s, scenario.drone.mission.radius_m) == ((2.0, -1.5), 15.0)


def test_what_cannot_be_set_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "--set", "vehicle.wind=[2, -1.5]"]) == 78
    assert capsys.readouterr().err.startswith("--set: vehicle.wind: is not a known key; ")
    assert main(["sim", "--set", "seed=[2"]) == 2
    assert "is no YAML" in capsys.readouterr().err

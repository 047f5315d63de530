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
from flockd.cli.sim import _scenario
from flockd.core.config import DroneConfig
from flockd.core.errors import ModelError, UnavailableError
from flockd.fleet.watcher import FleetWatcher
from flockd.review.flight_log.log import FlightLog
from flockd.sim.sitl.processes import free_endpoint
from flockd.sim.vehicles.vehicles import Vehicles
from tests.conftest import Told

Capture = pytest.CaptureFixture[str]
ROOT = Path(__file__).parents[2]
PAPER_FLIGHT = (ROOT / "config" / "paper_flight.yaml").read_text(encoding="utf-8")
SIMULATOR = (ROOT / "config" / "simulator.yaml").read_text(encoding="utf-8")
TRUTH = ("sim", "--perception", "truth")


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


@pytest.mark.parametrize("command", list(commands(_parser())), ids=" ".join)
def test_help_shows_examples_of_the_command(command: list[str], told: Told) -> None:
    examples = told(0, *command, "--help").split("examples:\n")[1].split("\n\n")[0].splitlines()
    assert examples
    assert all(" ".join(["flockd", *command]) in example for example in examples)


def test_help_needs_nothing_but_python() -> None:
    """Only rich is loaded of what is installed before a command runs."""
    heavy = {"numpy", "pydantic", "yaml", "cv2", "onnxruntime", "zenoh", "numba", "matplotlib", "jinja2"}
    code = f"import sys, flockd.cli; print(*{heavy!r} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == ""


def test_version(told: Told) -> None:
    package = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert package["project"]["dynamic"] == ["version"], "it stands in flockd/__init__.py alone"
    assert told(0, "--version") == f"flockd {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "of", "says"),
    [
        (["sims"], "flockd", "did you mean `flockd sim`?"),
        (["status", "--once"], "flockd status", "unknown argument --once"),
        (["status", "--fleet", "a/b"], "flockd status", "--fleet: 'a/b' is not a fleet's name, of letters"),
        (["run", "--config", "a.yaml", "--record", ""], "flockd run", "--record: '' is no path; name one"),
        (["fleet", "hold", "a,,b"], "flockd fleet hold", "DRONES: '' is not a drone's name; write names with commas"),
        (["fleet", "hold", "all,a"], "flockd fleet hold", "DRONES: 'all,a' names `all` beside others; write one of"),
        (["run", "--config", "a.yaml", "--config", "b.yaml"], "flockd run", "--config: is given twice; leave one out"),
        (["record", "xyz"], "flockd record", "'xyz' is not a command, of info"),
        (["fleet", "--port", "99999"], "flockd fleet", "--port: '99999'"),
        (["fleet", "--listen", "tcp/0.0.0.0:7447"], "flockd fleet", "--listen: 'tcp/0.0.0.0:7447'"),
        (["replay", "x.mcap", "--start", "-1"], "flockd replay", "--start: '-1'"),
        (["replay", "x.mcap", "--tolerance", "command"], "flockd replay", "--tolerance: 'command'"),
        (["replay", "x.mcap", "--tolerance", "command=-1"], "flockd replay", "--tolerance: 'command=-1'"),
        (["sim", "--set", "seed"], "flockd sim", "--set: 'seed'"),
        (["sim", "--set", "seed=1", "--set", "seed=2"], "flockd sim", "--set: seed is given twice; leave one out"),
        (["doctor", "--bench", "--demo", "--seconds", "0.2"], "flockd doctor", "--seconds: '0.2' is not a number of"),
        (["sim", "--duration", "-3"], "flockd sim", "--duration: '-3'"),
        (["sim", "--duration", "nan"], "flockd sim", "--duration: 'nan'"),
        (["sim", "--drones", "0"], "flockd sim", "--drones: '0'"),
        (["sim", "--drones", "5000"], "flockd sim", "--drones: '5000' is more than the 100 drones"),
        (["sim", "--drones", "2.5"], "flockd sim", "--drones: '2.5'"),
        (["sim", "--seed", "9" * 5000], "flockd sim", f"--seed: '{'9' * 5000}'"),
        # The command's default would replace what stands before it: the hold went to every fleet.
        (["fleet", "--fleet", "other", "hold", "drone2"], "flockd fleet", "--fleet stands before the command "),
        (["fleet", "--connect=tcp/127.0.0.1:1", "hold", "a"], "flockd fleet", "--connect=tcp/127.0.0.1:1 stands"),
    ],
)
def test_a_slip_on_the_command_line_is_a_usage_error(arguments: list[str], of: str, says: str, told: Told) -> None:
    error = told(2, *arguments)
    assert error.startswith(f"{of}: ")
    assert says in error
    assert f"see {of} --help" in error


@pytest.mark.parametrize(
    "command",
    """run --config,status --zenoh-config,fleet hold all --zenoh-config,ros perceive --config,doctor --config,sim,
    campaign run,campaign report,report,record info,replay,replay tests/review/replay/normal.mcap --config,detect,
    detect docs/pictures/by_sight.webp --config,calibrate camera,calibrate camera --config,calibrate import,
    calibrate rig --from-flight,config check,config check config/simulator.yaml,config show,config card,
    models list --dir,models prepare --config,models import --drone 0""".replace("\n", "").split(","),
)
def test_a_missing_file_is_the_command_lines_fault_in_every_command(command: str, told: Told) -> None:
    assert told(2, *command.split(), "nowhere") == "nowhere: does not exist; check the path\n"


@pytest.mark.parametrize("command", [[], ["record"], ["config"], ["calibrate"]], ids=" ".join)
def test_without_a_command_the_help_is_shown(command: list[str], capsys: Capture) -> None:
    assert main(command) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(" ".join(["usage: flockd", *command]))
    assert "examples:\n" in captured.err


@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        (["--perception", "truth", "--set", "drone.perception.flow=dis"], 2, "--set drone.perception.flow has no"),
        (["--perception", "truth", "--set", "cameras.preset=realistic"], 2, "--set cameras.preset has no meaning"),
        (["--perception", "truth", "--record"], 2, "--record has no meaning without networks"),
        (["--set", "vehicle.wind=[2, -1.5]"], 78, "--set: vehicle.wind: is not a known key"),
        (["--set", "seed=[2"], 2, "is not YAML"),
        (["--seed", "1", "--set", "seed=2"], 2, "--set seed says what an option says too; leave one out"),
        (["--drones", "3", "--set", "vehicles=[]"], 2, "--set vehicles says what an option says too; leave one out"),
        (["--duration", "0.1"], 78, "--duration: 0.1 s is shorter than a step of 0.5 s"),
        (["--live", "--record"], 2, "--live keeps nothing"),
        (["--live", "--telemetry"], 2, "--live has --telemetry in it"),
        (["--video", "flock.mp4"], 2, "--video is for --live"),
        (["--live", "--video", "flock.gif"], 2, "does not end in .mp4"),
        (["--live", "--video", "no_folder/flock.mp4"], 2, "there is no folder no_folder"),
        (["--live", "--autopilot", "fake"], 2, "drop --autopilot"),
        (["--live", "--duration", "5"], 2, "flies on until Ctrl-C"),
        (["--port", "8000"], 2, "--port is for --live"),
        (["--telemetry-at", "tcp/127.0.0.1:7999"], 2, "--telemetry-at is for --telemetry, --live and --autopilot"),
        (["--speed-factor", "0.5"], 2, "--speed-factor is for real daemons"),
        (["--autopilot", "fake", "--speed-factor", "0.01"], 2, "'0.01' is not a number from 0.02 to 10"),
        (["--autopilot", "fake", "--perception", "truth"], 2, "--perception truth has no meaning with real daemons"),
    ],
)
def test_a_flight_that_cannot_be_is_refused(options: list[str], code: int, says: str, told: Told) -> None:
    assert says in told(code, "sim", *options)


@pytest.mark.parametrize("command", [["config", "check"], ["config", "show"], ["sim"]], ids=" ".join)
def test_a_wrong_scenario_is_told_in_one_sentence(scenario: Path, command: list[str], told: Told) -> None:
    """`tests/core/config` has the sentences for all slips."""
    scenario.write_text(PAPER_FLIGHT.replace("duration_s:", "duration:"), encoding="utf-8")
    assert told(78, *command, scenario).startswith(f"{scenario}:3: duration: ")


def test_config_check_finds_models_that_are_not_there(scenario: Path, told: Told) -> None:
    drone = scenario.with_name("simulator.yaml")
    drone.write_text(SIMULATOR.replace("flow: flow_int8", "flow: flow_in8"), encoding="utf-8")
    error = told(78, "config", "check", scenario)
    assert error.startswith(f"{drone}:23: perception.flow: flow_in8 ")
    assert error.endswith("write one of flow, flow_int8, dis\n")
    drone.write_text(SIMULATOR.replace("flow: flow_int8", "flow: distance_int8"), encoding="utf-8")
    error = told(78, "config", "check", drone)
    assert error.startswith(f"{drone}:23: perception.flow: distance_int8 is for distance, not for ")


def test_config_check_tells_what_a_drone_could_not_start_with_or_would_not_see(
    scenario: Path, told: Told, capsys: Capture
) -> None:
    drone = scenario.with_name("simulator.yaml")
    drone.write_text(f"{SIMULATOR}\ntelemetry: {{zenoh_config: none.json5}}\n", encoding="utf-8")
    problem = told(78, "config", "check", drone)
    assert f"telemetry.zenoh_config: {drone.with_name('none.json5')}: cannot be used as zenoh's settings (" in problem
    drone.write_text(SIMULATOR.replace("yaw_deg: 90.0", "yaw_deg: 1.57"), encoding="utf-8")
    assert main(["config", "check", str(drone)]) == 0
    blind = f"warning: {drone}: coverage: blind at the horizon from "
    assert capsys.readouterr().err.startswith(blind)
    drone.write_text(SIMULATOR.replace("position_m: [0.10,", "position_m: [100,"), encoding="utf-8")
    told_of = told(78, "config", "check", drone)
    assert ".extrinsics.position_m[0]: 100 is not at most 5; write a number of metres from -5 to 5" in told_of


def test_config_check_reports_for_people_and_machines(scenario: Path, told: Told, capsys: Capture) -> None:
    drone = scenario.with_name("simulator.yaml")
    assert told(0, "config", "check", scenario, drone) == f"{scenario}: fine\n{drone}: fine\n"
    assert json.loads(told(0, "config", "check", "--json", scenario)) == {"ok": True, "problems": []}

    drone.write_text(SIMULATOR.replace("yaw: course", "yaw: corse"), encoding="utf-8")
    assert main(["config", "check", "--json", str(scenario), str(drone)]) == 78
    report = json.loads(capsys.readouterr().out)
    (problem,) = report["problems"]
    assert not report["ok"]
    assert problem.pop("message")
    line = SIMULATOR.splitlines().index("yaw: course") + 1
    assert problem == {"file": str(drone), "line": line, "key": "yaw"}, "of a file named twice it is told once"


def test_every_shipped_configuration_is_fine(told: Told) -> None:
    told(0, "config", "check", *(ROOT / "config").glob("*.yaml"))


@pytest.mark.parametrize("name", ["simulator.yaml", "flight.yaml"])
def test_config_show_fills_in_the_defaults_and_can_be_loaded_again(scenario: Path, name: str, told: Told) -> None:
    file = scenario.with_name(name)
    values = json.loads(told(0, "config", "show", "--json", file))
    drone = values.get("drone", values)
    assert drone["flocking"]["desired_distance_m"] == 3.5, "the paper's D_d, which the file leaves out"
    file.write_text(told(0, "config", "show", file), encoding="utf-8")
    told(0, "config", "check", file)
    assert json.loads(told(0, "config", "show", "--json", file)) == values


@pytest.mark.parametrize("kind", ["drone", "scenario", "campaign"])
def test_config_schema_is_json(kind: str, told: Told) -> None:
    schema = json.loads(told(0, "config", "schema", kind))
    assert (schema["type"], schema["additionalProperties"]) == ("object", False)


def test_a_folder_with_other_files_is_not_flown_into(tmp_path: Path, told: Told) -> None:
    (tmp_path / "thesis.txt").write_text("the only copy", encoding="utf-8")
    flight = ("sim", "--duration", "1", "--out")
    assert told(2, *flight, tmp_path).startswith(f"{tmp_path}: holds other files than a flight's; ")
    file = tmp_path / "thesis.txt"
    assert told(2, *flight, file).startswith(f"{file}: is a file; ")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_report_of_no_flight_or_a_damaged_log(tmp_path: Path, told: Told) -> None:
    assert told(2, "report", tmp_path).startswith(f"{tmp_path}: holds neither a flight's flight.npz nor recordings; ")
    log = tmp_path / "flight.npz"
    for content in (b"", b"PK\x03\x04 cut off", b"something else"):
        log.write_bytes(content)
        problem = told(2, "report", tmp_path)
        assert problem.startswith(f"{log}: is not a whole flight log (")
        assert "pickle" not in problem


@pytest.mark.parametrize(
    ("line", "words"), [("flockd rep", {"report", "replay"}), ("flockd sim --pe", {"--perception"})]
)
def test_a_shell_completes_commands_and_options(line: str, words: set[str]) -> None:
    """As argcomplete's script for bash asks: by environment, with the answer on file descriptor 8."""
    code = "import os, sys; from flockd.cli import main; os.dup2(1, 8); sys.argv[0] = 'flockd'; main()"
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n"}
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **asked}, capture_output=True, text=True, check=False
    )
    assert {word.strip() for word in done.stdout.splitlines()} == words, done.stderr


@pytest.mark.parametrize(
    ("error", "code", "sentence"),
    [
        (ModuleNotFoundError("", name="numba"), 69, f"numba is not installed; {installing('sim')}"),
        (OSError(13, "Denied", "out"), 69, "out: Denied; check the path, its permissions and the disk"),
        (OSError(28, "No space left on device"), 69, "the system: No space left on device; make room on the disk"),
        (ModelError("models/flow.yaml: sha256: differs"), 78, "models/flow.yaml: sha256: differs"),
    ],
    ids=["a missing extra", "a folder", "a full disk", "a damaged model"],
)
def test_what_a_flight_lacks_is_one_sentence(
    error: Exception, code: int, sentence: str, monkeypatch: pytest.MonkeyPatch, told: Told
) -> None:
    def fails(_: object) -> int:
        raise error

    monkeypatch.setattr("flockd.cli.sim._scenario", fails)
    assert told(code, "sim") == f"{sentence}\n"


def test_ctrl_c_while_a_library_is_imported_ends_a_command_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, told: Told
) -> None:
    """pybind11 reports it as an ImportError, as of ONNX Runtime."""

    def interrupted(_: object) -> int:
        raise ImportError("initialization failed") from KeyboardInterrupt()

    monkeypatch.setattr("flockd.cli.sim._scenario", interrupted)
    assert told(130, "sim") == "interrupted\n"


def test_an_extra_is_added_to_a_checkout_without_freezing_it() -> None:
    assert installing("view") == f"run: {sys.executable} -m pip install -e '{ROOT}[view]'"


@pytest.fixture
def unreported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flockd.review.report.flight_folder.write_report", lambda folder, *_: folder)


def test_a_flight_leaves_its_log_summary_and_report(tmp_path: Path, told: Told) -> None:
    folder = tmp_path / "flight"
    short = (*TRUTH, "--duration", "5", "--drones", "3", "--seed", "3", "--out", folder)
    summary = json.loads(told(0, *short, "--json"))
    assert (summary["drones"], summary["duration_s"], summary["seed"]) == (3, 5.0, 3)
    assert {"flight.npz", "summary.json", "report.html"} <= {path.name for path in folder.iterdir()}
    assert json.loads((folder / "summary.json").read_text(encoding="utf-8")) == summary

    (folder / "summary.json").unlink()
    (folder / "report.html").unlink()
    table = told(0, "report", folder)
    assert f"{summary['flock']['min_distance_m']:.2f} m" in table
    assert table.splitlines()[-1] == f"report: {folder / 'report.html'}"
    assert json.loads((folder / "summary.json").read_text(encoding="utf-8")) == summary
    assert (folder / "report.html").is_file()


@pytest.mark.usefixtures("unreported")
def test_a_flight_is_not_flown_over_another_without_force(tmp_path: Path, told: Told) -> None:
    short = (*TRUTH, "--duration", "2", "--quiet", "--out", tmp_path / "flight")
    told(0, *short)
    assert told(2, *short).startswith(f"{tmp_path / 'flight'}: holds a flight; ")
    (tmp_path / "flight" / "recordings").mkdir()
    (tmp_path / "flight" / "recordings" / "drone1.mcap").touch()
    assert told(0, *short, "--force") == f"{tmp_path / 'flight' / 'report.html'}\n"
    assert not (tmp_path / "flight" / "recordings").exists(), "nothing of the flight before is left beside the new one"


@pytest.mark.usefixtures("unreported")
def test_each_flight_has_its_own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: Told) -> None:
    monkeypatch.chdir(tmp_path)
    short = (*TRUTH, "--duration", "2", "--quiet")
    for expected in ("", "-2", "-3"):
        assert told(0, *short) == f"out/paper_flight-truth-duration_2-seed0{expected}/report.html\n"
    windy = (*TRUTH, "--quiet", "--set", "vehicle.wind_m_s=[3,-1.5]", "--drones=3", "--no-gate", "--duration", "3")
    folder = "out/paper_flight-truth-duration_3-drones_3-wind_m_s_3,-1.5-no-gate-seed0"
    assert told(0, *windy) == f"{folder}/report.html\n"


@pytest.mark.usefixtures("unreported")
def test_a_flight_is_watched_where_it_is_told_to_be(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    flight = ["sim", "--perception", "truth", "--telemetry", "--telemetry-at", endpoint, "--drones", "2"]
    with FleetWatcher(None, listen=[], connect=[endpoint]) as watcher:
        assert main([*flight, "--duration", "4", "--out", str(tmp_path / "out")]) == 0
        assert {one.drone for one in watcher.drones()} == {"drone1", "drone2"}


def test_an_interrupted_flight_leaves_its_report_and_can_be_flown_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    step, steps = Vehicles.step, iter(range(1000))

    def interrupted(vehicles: Vehicles, *arguments: object) -> None:
        if next(steps) == 70:  # ten setpoints a step
            raise KeyboardInterrupt
        step(vehicles, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Vehicles, "step", interrupted)
    folder = tmp_path / "flight"
    command = [*TRUTH, "--duration", "5", "--quiet", "--out", str(folder)]
    assert main(command) == 130
    captured = capsys.readouterr()
    assert captured.out == f"{folder / 'report.html'}\n"
    assert captured.err.startswith("interrupted after 3.5 s of 5 s; ")
    log = FlightLog.load(folder / "flight.npz")
    assert (len(log.time_s), log.metadata.duration_s, log.metadata.interrupted) == (7, 3.5, True)
    assert log.truth_position.shape == (7, 5, 3)

    monkeypatch.setattr(Vehicles, "step", step)
    assert main(command) == 0, "the same command works again"
    moved = tmp_path / "flight-interrupted"
    assert f"{moved}" in capsys.readouterr().err
    assert FlightLog.load(moved / "flight.npz").metadata.interrupted
    assert not FlightLog.load(folder / "flight.npz").metadata.interrupted


def test_the_daemons_of_a_simulation_connect_where_they_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connected: list[tuple[str, ...]] = []

    def fly_fleet(scenario: object, sitl: DroneConfig, **_: object) -> None:
        connected.append(sitl.telemetry.connect)
        raise UnavailableError("no autopilot for this test; end here")

    monkeypatch.setattr("flockd.sim.sitl.fleet.fly_fleet", fly_fleet)
    flight = ["sim", "--autopilot", "fake", "--drones", "2", "--out"]
    assert main([*flight, str(tmp_path / "one")]) == 69
    assert main([*flight, str(tmp_path / "two"), "--telemetry-at", "tcp/127.0.0.1:7999"]) == 69
    assert connected == [("tcp/127.0.0.1:7447",), ("tcp/127.0.0.1:7999",)]


def test_what_is_set_is_what_is_flown() -> None:
    mission = "drone.mission={kind: circle_then_tangent, radius_m: 15.0}"
    scenario = _scenario(_parser().parse_args(["sim", "--set", "vehicle.wind_m_s=[2, -1.5]", "--set", mission]))
    assert (scenario.vehicle.wind_m_s, scenario.drone.mission.radius_m) == ((2.0, -1.5), 15.0)

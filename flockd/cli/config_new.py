"""`flockd config new`: writes a commented configuration to begin with."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flockd.cli.output import say
from flockd.cli.parser import Commands, Parser, add_commands, positive_count, positive_number, size
from flockd.core.errors import ConfigError, ExitCode, UsageError

MISSIONS = ("circle_then_tangent", "hover", "velocity", "waypoints", "follow", "operator")
OBSTACLES = ("none", "forest", "village")
SOURCES = ("v4l2", "gstreamer", "ros", "shared_memory")
MOST_CAMERAS = 16
LEAST_MAX_HEIGHT_M, ABOVE_LAYER_M = 10.0, 3.0
"""The gate's limit of height in a new file: at least, and above the layer of first flights."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = ("flockd config new drone my_drone.yaml", "flockd config new scenario my_flight.yaml --drones 3")
    parser = commands(
        "new", "Write a commented file of a drone or a scenario, which `flockd config check` passes.", examples, _NOTES
    )
    add_commands(parser, (_add_drone, _add_scenario))


_NOTES = """\
On a terminal it asks for what no option gives, with the default in brackets; with --defaults it asks nothing."""


@dataclass(frozen=True)
class _Question:
    """One value of the new file: an option, and on a terminal a question for who does not give it."""

    option: str
    help: str
    asks: str
    default: str
    kind: Callable[[str], Any] = str
    metavar: str | None = None
    choices: tuple[str, ...] | None = None

    @property
    def key(self) -> str:
        return self.option.replace("-", "_")

    def add(self, parser: Parser) -> None:
        parser.add_argument(
            f"--{self.option}", metavar=self.metavar, type=self.kind, choices=self.choices, help=self.help
        )

    def answer(self, args: argparse.Namespace) -> Any:
        """The option's value; else what is answered on a terminal, until it is one; else the default."""
        given = getattr(args, self.key)
        if given is not None:
            return given
        if args.defaults or not sys.stdin.isatty():
            return self.kind(self.default)
        asks = f"{self.asks} ({', '.join(self.choices)})" if self.choices else self.asks
        while True:
            answer = input(f"{asks} [{self.default}]: ").strip() or self.default
            try:
                value = self.kind(answer)
            except argparse.ArgumentTypeError as error:
                say(str(error))
                continue
            if self.choices is None or value in self.choices:
                return value
            say(f"{answer!r} is not one of {', '.join(self.choices)}")


def _drone_questions() -> tuple[_Question, ...]:
    return (
        _Question("name", "its name in telemetry and recordings", "name of the drone", "drone1", _name, "NAME"),
        _Question(
            "number",
            "its number in the flock, from 1: the layer of its first flights",
            "number of the drone in its flock",
            "1",
            positive_count,
            "N",
        ),
        _Question(
            "cameras", "number of cameras, evenly spaced around the drone", "number of cameras", "4", _camera_count, "N"
        ),
        _Question(
            "size",
            "of an image in pixels, where up is up: higher than wide for cameras on their side",
            "size of an image",
            "480x640",
            size,
            "WxH",
        ),
        _Question(
            "field-of-view",
            "of an image's longer side, 10 to 190",
            "field of view in degrees",
            "130",
            _field_of_view,
            "DEG",
        ),
        _Question(
            "source",
            "USB cameras, others through GStreamer, topics of ROS 2, or another program's frames",
            "frames from",
            "v4l2",
            choices=SOURCES,
        ),
        _Question(
            "autopilot",
            "serial:///dev/NAME:BAUD or udpin://0.0.0.0:PORT",
            "address of the autopilot",
            "serial:///dev/ttyAMA0:921600",
            _address,
            "ADDRESS",
        ),
        _Question("fleet", "the fleet's name in telemetry", "name of the fleet", "fleet", _name, "NAME"),
        _Question("mission", "kind of mission", "mission", "hover", choices=MISSIONS),
    )


def _scenario_questions(name: str = "", drone_file: str = "") -> tuple[_Question, ...]:
    return (
        _Question("name", "of the flight", "name of the flight", name, metavar="NAME"),
        _Question("drones", "size of the flock, 1 to 100", "number of drones", "5", _drone_count, "N"),
        _Question("duration", "seconds to fly", "seconds to fly", "60", positive_number, "S"),
        _Question("mission", "kind of mission", "mission", MISSIONS[0], choices=MISSIONS),
        _Question("obstacles", "what the flock flies between", "obstacles", "none", choices=OBSTACLES),
        _Question(
            "drone",
            "the drones' configuration (default: that of the simulated drone that comes with flockd)",
            "file of the drones",
            drone_file,
            _drone_file,
            "FILE",
        ),
    )


def _add_drone(commands: Commands) -> None:
    examples = (
        "flockd config new drone my_drone.yaml",
        "flockd config new drone my_drone.yaml --name kite1 --cameras 3 --size 1280x720 --field-of-view 130",
    )
    _add_new(commands("drone", "Write the configuration of a real drone.", examples), _drone_questions(), _new_drone)


def _add_scenario(commands: Commands) -> None:
    examples = (
        "flockd config new scenario my_flight.yaml",
        "flockd config new scenario my_flight.yaml --drones 3 --duration 60 --mission waypoints --defaults",
    )
    parser = commands("scenario", "Write the configuration of a simulated flight.", examples)
    _add_new(parser, _scenario_questions(), _new_scenario)


def _add_new(parser: Parser, questions: Sequence[_Question], run: Callable[[argparse.Namespace], int]) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="to write")
    parser.add_argument("--force", action="store_true", help="overwrite the file if it exists")
    parser.add_argument("--defaults", action="store_true", help="ask nothing; what no option gives has its default")
    for question in questions:
        question.add(parser)
    parser.set_defaults(run=run)


def _new_drone(args: argparse.Namespace) -> int:
    from flockd.core.config.new_files import camera_names, new_file, rig_cameras, source_cameras
    from flockd.core.config.safety import layer_height_m

    _refuse_what_is_there(args)
    answers = {question.key: question.answer(args) for question in _drone_questions()}
    names = camera_names(answers["cameras"])
    rig = rig_cameras(dict.fromkeys(names, answers["size"]), answers["field_of_view"])
    max_height_m = max(LEAST_MAX_HEIGHT_M, layer_height_m(answers["number"]) + ABOVE_LAYER_M)
    values = answers | {
        "rig": rig,
        "max_height": f"{max_height_m:.1f}",
        "cameras": source_cameras(answers["source"], names, upright=answers["size"][1] > answers["size"][0]),
    }
    write_checked(args.file, new_file("drone", values, (answers["source"], answers["mission"])))
    return ExitCode.DONE


def _new_scenario(args: argparse.Namespace) -> int:
    from flockd.core.config.new_files import new_file, start_positions
    from flockd.core.data import data_path

    _refuse_what_is_there(args)
    simulated = _path_from(args.file.resolve().parent, data_path("config") / "simulator.yaml")
    answers = {question.key: question.answer(args) for question in _scenario_questions(args.file.stem, simulated)}
    values = answers | {"duration": f"{answers['duration']:g}", "vehicles": start_positions(answers["drones"])}
    write_checked(args.file, new_file("scenario", values, (answers["mission"], answers["obstacles"])))
    return ExitCode.DONE


def _name(text: str) -> str:
    from flockd.core.config import DroneConfig

    return _valid(DroneConfig, "name", text)


def _address(text: str) -> str:
    from flockd.core.config.autopilot import AutopilotParameters

    return _valid(AutopilotParameters, "address", text)


def _valid(section: type[Any], key: str, text: str) -> str:
    """Raises ArgumentTypeError for a value that the file could not have, so that it is asked for again."""
    from flockd.core.config.loader import fault_of

    fault = fault_of(section, key, text)
    if fault is not None:
        raise argparse.ArgumentTypeError(fault)
    return text


def _drone_file(text: str) -> str:
    from flockd.core.config import load_drone

    try:
        load_drone(text)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error.problems[0])) from error
    return text


def _camera_count(text: str) -> int:
    count = positive_count(text)
    if count > MOST_CAMERAS:
        raise argparse.ArgumentTypeError(f"{text!r} is more than {MOST_CAMERAS} cameras")
    return count


def _drone_count(text: str) -> int:
    from flockd.core.config.scenario import MAX_DRONES

    count = positive_count(text)
    if count > MAX_DRONES:
        raise argparse.ArgumentTypeError(f"{text!r} is more than {MAX_DRONES} drones")
    return count


def _field_of_view(text: str) -> float:
    degrees = positive_number(text)
    if not 10.0 <= degrees <= 190.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not an angle from 10 to 190 degrees")
    return degrees


def _path_from(folder: Path, file: Path) -> str:
    """To write into a file in this folder: the whole path, unless the other file is in the same folder."""
    return file.name if folder == file.resolve().parent else str(file.resolve())


def _refuse_what_is_there(args: argparse.Namespace) -> None:
    """Before anything is asked."""
    if args.file.exists() and not args.force:
        raise UsageError(f"{args.file} exists; name another file, or overwrite it with --force")
    if not args.file.parent.is_dir():
        raise UsageError(f"{args.file.parent} is not a folder; make it first")


def write_checked(file: Path, text: str) -> None:
    """Writes the file if it checks, else leaves all as it was. Raises UsageError.

    The draft stands beside it: paths count from there.
    """
    from flockd.core.config import load

    draft = file.with_name(f".{file.name}.draft.yaml")
    try:
        draft.write_text(text, encoding="utf-8")
        load(draft)
        draft.replace(file)
    except ConfigError as error:
        reasons = "; ".join(f"{problem.key}: {problem.message}" for problem in error.problems)
        raise UsageError(f"{file} was not written, as it would not check ({reasons}); change the options") from error
    finally:
        draft.unlink(missing_ok=True)
    say(f"{file}: written; `flockd config check {file}` checks it again after each change")

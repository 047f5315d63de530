"""`flockd config new`: writes a commented configuration to begin with."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.output import say
from flockd.cli.parser import Commands, Parser, add_commands, positive_count, positive_number
from flockd.core.errors import ConfigError, ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.core.config.new_files import NewDrone, NewScenario

MISSIONS = ("circle_then_tangent", "hover", "velocity", "waypoints", "follow", "operator")
OBSTACLES = ("none", "forest", "village")
SOURCES = ("v4l2", "gstreamer", "shared_memory")
MOST_CAMERAS = 16


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = ("flockd config new drone my_drone.yaml", "flockd config new scenario my_flight.yaml --drones 3")
    parser = commands(
        "new", "Write a commented file of a drone or a scenario, which `flockd config check` passes.", examples, _NOTES
    )
    add_commands(parser, (_add_drone, _add_scenario))


_NOTES = """\
On a terminal it asks for what no option gives, with the default in brackets; with --defaults it asks nothing."""


def _add_drone(commands: Commands) -> None:
    examples = (
        "flockd config new drone my_drone.yaml",
        "flockd config new drone my_drone.yaml --name kite1 --cameras 3 --size 1280x720 --field-of-view 130",
    )
    parser = commands("drone", "Write the configuration of a real drone.", examples)
    _add_common(parser)
    parser.add_argument("--name", metavar="NAME", help="its name in telemetry and recordings")
    parser.add_argument(
        "--cameras", metavar="N", type=_camera_count, help="number of cameras, evenly spaced around the drone"
    )
    parser.add_argument("--size", metavar="WxH", type=image_size, help="of an image in pixels")
    parser.add_argument("--field-of-view", metavar="DEG", type=_field_of_view, help="of an image's width, 10 to 190")
    parser.add_argument(
        "--source", choices=SOURCES, help="USB cameras, others through GStreamer, or frames from another program"
    )
    parser.add_argument("--autopilot", metavar="ADDRESS", help="serial:///dev/NAME:BAUD or udpin://0.0.0.0:PORT")
    parser.add_argument("--fleet", metavar="NAME", help="the fleet's name in telemetry")
    parser.add_argument("--mission", choices=MISSIONS, help="kind of mission")
    parser.set_defaults(run=_new_drone)


def _add_scenario(commands: Commands) -> None:
    examples = (
        "flockd config new scenario my_flight.yaml",
        "flockd config new scenario my_flight.yaml --drones 3 --duration 30 --mission waypoints --defaults",
    )
    parser = commands("scenario", "Write the configuration of a simulated flight.", examples)
    _add_common(parser)
    parser.add_argument("--name", metavar="NAME", help="of the flight")
    parser.add_argument("--drones", metavar="N", type=_drone_count, help="size of the flock, 1 to 100")
    parser.add_argument("--duration", metavar="S", type=positive_number, help="seconds to fly")
    parser.add_argument("--mission", choices=MISSIONS, help="kind of mission")
    parser.add_argument("--obstacles", choices=OBSTACLES, help="what the flock flies between")
    parser.add_argument(
        "--drone",
        metavar="FILE",
        help="the drones' configuration (default: that of the simulated drone that comes with flockd)",
    )
    parser.set_defaults(run=_new_scenario)


def _add_common(parser: Parser) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="to write")
    parser.add_argument("--force", action="store_true", help="overwrite the file if it exists")
    parser.add_argument("--defaults", action="store_true", help="ask nothing; what no option gives has its default")


def _new_drone(args: argparse.Namespace) -> int:
    from flockd.core.config.new_files import NewDrone, drone_text

    _refuse_what_is_there(args)
    default = NewDrone()
    new: NewDrone = dataclasses.replace(
        default,
        name=_asked(args, "name", "name of the drone", default.name, str),
        cameras=_asked(args, "cameras", "number of cameras", default.cameras, _camera_count),
        size_px=_asked(
            args, "size", "size of an image", default.size_px, image_size, "x".join(map(str, default.size_px))
        ),
        field_of_view_deg=_asked(
            args, "field_of_view", "field of view in degrees", default.field_of_view_deg, _field_of_view
        ),
        source=_asked(args, "source", _choice("frames from", SOURCES), default.source, _one_of(SOURCES)),
        autopilot=_asked(args, "autopilot", "address of the autopilot", default.autopilot, str),
        fleet=_asked(args, "fleet", "name of the fleet", default.fleet, str),
        mission=_asked(args, "mission", _choice("mission", MISSIONS), default.mission, _one_of(MISSIONS)),
    )
    return _write(args.file, drone_text(new))


def _new_scenario(args: argparse.Namespace) -> int:
    from flockd.core.config.new_files import NewScenario, scenario_text
    from flockd.core.data import data_path

    _refuse_what_is_there(args)
    simulated = _path_from(args.file.resolve().parent, data_path("config") / "simulator.yaml")
    default = NewScenario(name=args.file.stem, drone_file=simulated)
    new: NewScenario = dataclasses.replace(
        default,
        name=_asked(args, "name", "name of the flight", default.name, str),
        drones=_asked(args, "drones", "number of drones", default.drones, _drone_count),
        duration_s=_asked(args, "duration", "seconds to fly", default.duration_s, positive_number),
        mission=_asked(args, "mission", _choice("mission", MISSIONS), default.mission, _one_of(MISSIONS)),
        obstacles=_asked(args, "obstacles", _choice("obstacles", OBSTACLES), default.obstacles, _one_of(OBSTACLES)),
        drone_file=_asked(args, "drone", "file of the drones", default.drone_file, str),
    )
    return _write(args.file, scenario_text(new))


def _asked(
    args: argparse.Namespace, option: str, question: str, default: Any, kind: Callable[[str], Any], shown: str = ""
) -> Any:
    """The option's value; else what is answered on a terminal, until it is one; else the default."""
    given = getattr(args, option)
    if given is not None:
        return given
    if args.defaults or not sys.stdin.isatty():
        return default
    while True:
        answer = input(f"{question} [{shown or default}]: ").strip()
        if not answer:
            return default
        try:
            return kind(answer)
        except argparse.ArgumentTypeError as error:
            say(str(error))


def _choice(question: str, choices: Sequence[str]) -> str:
    return f"{question} ({', '.join(choices)})"


def _one_of(choices: Sequence[str]) -> Callable[[str], str]:
    def chosen(text: str) -> str:
        if text not in choices:
            raise argparse.ArgumentTypeError(f"{text!r} is not one of {', '.join(choices)}")
        return text

    return chosen


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


def image_size(text: str) -> tuple[int, int]:
    """An option's value as width and height."""
    width, _, height = text.partition("x")
    try:
        return positive_count(width), positive_count(height)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 640x480") from error


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


def _write(file: Path, text: str) -> int:
    write_checked(file, text)
    return ExitCode.DONE


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

"""Options that several commands have, and what they are made into."""

from __future__ import annotations

import argparse
import getpass
import re
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.output import complain, progress
from flockd.cli.parser import OnceEach, Parser, existing, flag, number, option, positive_number
from flockd.core.errors import ConfigError, ConfigProblem, UsageError
from flockd.core.printable import printable

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.onboard.recording.reader import Recording

ENDPOINT = "tcp/127.0.0.1:7447"
LONGEST_OPERATOR = 40
"""The page adds its number, and where it is open."""


def add_endpoint_options(parser: Parser, listen: str = "--listen") -> None:
    """Adds the fleet's name and the endpoints; ``listen``: the option for the endpoint at which it listens."""
    option(parser, "--fleet NAME", "only the drones of this fleet (default: of every fleet that is found)", _fleet)
    option(parser, "--connect ENDPOINT", f"connect to this drone or router (default: {ENDPOINT})", action="append")
    told = "listen here for drones that connect to this computer"
    option(parser, f"{listen} ENDPOINT", told, action="append", dest="drones_at")
    option(parser, "--zenoh-config FILE", "zenoh's own configuration file, for example for TLS", existing)


def _fleet(text: str) -> str:
    from flockd.onboard.telemetry.topics import is_name

    if not is_name(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a fleet's name, of letters, digits, `_`, `.` and `-`")
    return text


def add_operator_option(parser: Parser) -> None:
    """Adds --operator, the name in which orders are given."""
    option(
        parser,
        "--operator NAME",
        "the operator's name, which drones show and log (default: USER@COMPUTER)",
        _operator,
        default=_this_person(),
    )


def _operator(text: str) -> str:
    if not 0 < len(text) <= LONGEST_OPERATOR or printable(text, lines=False) != text:
        raise argparse.ArgumentTypeError(f"{text!r} is not a name of 1 to {LONGEST_OPERATOR} printable characters")
    return text


def _this_person() -> str:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # of a number without a name
        user = "somebody"
    return printable(f"{user}@{socket.gethostname()}", lines=False)[:LONGEST_OPERATOR]


def endpoints(args: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Where to listen and what to connect to, as the options say; else the default alone."""
    listen, connect = args.drones_at or [], args.connect or []
    return listen, connect if connect or listen else [ENDPOINT]


def add_settings(parser: Parser, what: str) -> None:
    """Adds --set, whose keys and values, as they were written, are `settings`."""
    option(
        parser,
        "--set KEY=VALUE",
        f"{what}, as in `--set seed=3` or `--set 'mission={{kind: hover}}'`; may be given again",
        _setting,
        action=OnceEach,
        default=[],
        dest="settings",
    )


def _setting(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or re.fullmatch(r"\w+(\.\w+)*", key) is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a key and its value, as in seed=3")
    return key, value


def add_stretch(parser: Parser) -> None:
    """Adds --start and --end, in seconds from the recording's first step."""
    option(parser, "--start S", "begin S seconds after the first step", number("a number, 0 or more", 0), default=0.0)
    option(parser, "--end S", "end S seconds after the first step", positive_number)


def stretch(recording: Recording, args: argparse.Namespace) -> tuple[float, float]:
    """From when to when, on the recording's clock, --start and --end ask for. Raises UsageError for an empty
    stretch."""
    rounding_s = 1e-6
    end_s = recording.duration_s if args.end is None else args.end
    begin, end = recording.start_s + args.start - rounding_s, recording.start_s + end_s + rounding_s
    if not any(begin <= time_s <= end for _, time_s in recording.contents.steps):
        raise UsageError(
            f"{recording.path}: has no step from {args.start:g} s to {end_s:g} s, as it is "
            f"{recording.duration_s:g} s long; choose --start and --end within it"
        )
    return begin, end


def opened(path: Path) -> Recording:
    """The recording, checked as a whole, with a progress bar. Raises RecordingError."""
    from flockd.onboard.recording.reader import Recording

    with progress("checking", "bytes") as tell:
        recording = Recording(path, tell)
    if recording.unknown:
        complain(f"warning: {path}: this flockd does not know {', '.join(recording.unknown)} of its configuration")
    return recording


def add_force(parser: Parser) -> None:
    """Adds --force, which permits values outside the proven envelope."""
    flag(parser, "--force", "accept speeds above those that were shown to be safe")


def load_to_fly(file: Path, *, force: bool) -> DroneConfig:
    """The configuration of a real drone. Raises ConfigError, without ``force`` also outside the proven envelope."""
    from flockd.core.config import load_real_drone

    config, outside = load_real_drone(file)
    permit(outside, force=force)
    return config


def permit(outside: Sequence[ConfigProblem], *, force: bool) -> None:
    """Reports values outside the proven envelope: with ``force`` as warnings, else by a ConfigError."""
    if outside and not force:
        raise ConfigError(outside)
    for problem in outside:
        complain(f"warning: {str(problem).rpartition('; ')[0]}; --force goes beyond it")


def loaded(file: Path | None) -> DroneConfig | None:
    """The drone of a file, which may also be a scenario; None without a file. Raises ConfigError."""
    from flockd.sim.scenario import ScenarioConfig, load

    if file is None:
        return None
    config = load(file)
    return config.drone if isinstance(config, ScenarioConfig) else config


def camera_of(config: DroneConfig, wanted: str | None, where: object) -> str:
    """The camera that is named, or the only one there is. Raises UsageError, which names ``where``."""
    names = [camera.name for camera in config.rig.cameras]
    name = wanted or (names[0] if len(names) == 1 else None)
    if name is None or name not in names:
        said = "has several cameras" if name is None else f"has no camera {name!r}"
        raise UsageError(f"{where}: {said}; choose with --camera from {', '.join(names)}")
    return name


def refuse(args: argparse.Namespace, options: Sequence[str], why: str) -> None:
    """Raises UsageError where one of these options is given."""
    for name in options:
        if getattr(args, name):
            raise UsageError(f"--{name.replace('_', '-')} {why}")


def refuse_overwriting(args: argparse.Namespace, *files: Path | None) -> None:
    """Raises UsageError where a result would take a file's place without --force: before the work, not after it."""
    force: bool | None = getattr(args, "force", None)
    for file in files:
        if file is not None and file.is_dir():
            raise UsageError(f"{file}: is a folder; name a file in it")
        if file is not None and file.exists() and not force:
            instead = "" if force is None else ", or overwrite it with --force"
            raise UsageError(f"{file}: exists; name another file{instead}")
        if file is not None and not file.parent.is_dir():
            raise UsageError(f"{file.parent}: is not a folder; create it first, or name another file")

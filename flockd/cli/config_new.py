"""`flockd config new`: writes a commented configuration to begin with."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from flockd.cli.output import say
from flockd.cli.parser import Commands, Parser, add_commands
from flockd.core.errors import ConfigError, ExitCode, UsageError

CHANGE_ME = "CHANGE-ME"
"""Stands in a new file for what only its owner knows."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = ("flockd config new drone my_drone.yaml", "flockd config new scenario my_flight.yaml")
    parser = commands("new", "Write a commented file of a drone or a scenario, to be filled in.", examples)
    add_commands(parser, (_add_drone, _add_scenario))


def _add_drone(commands: Commands) -> None:
    examples = (
        "flockd config new drone my_drone.yaml",
        "flockd config new drone my_drone.yaml --set name=kite2 --set safety.first_flight_layer=2",
    )
    _add_options(commands("drone", "Write the configuration of a real drone.", examples), "drone")


def _add_scenario(commands: Commands) -> None:
    examples = (
        "flockd config new scenario my_flight.yaml",
        "flockd config new scenario woods.yaml --set world.obstacles.kind=forest --set obstacles.enabled=true",
    )
    _add_options(commands("scenario", "Write the configuration of a simulated flight.", examples), "scenario")


def _add_options(parser: Parser, kind: str) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="to write")
    parser.add_argument("--force", action="store_true", help="overwrite the file if it exists")
    parser.add_argument(
        "--set", metavar="KEY=VALUE", type=_setting, action="append", default=[], dest="settings",
        help="write this value, as in `--set seed=3` or `--set 'mission={kind: hover}'`; may be given again",
    )  # fmt: skip
    parser.set_defaults(run=_run, kind=kind)


def _setting(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or re.fullmatch(r"\w+(\.\w+)*", key) is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a key and its value, as in seed=3")
    return key, value


def _run(args: argparse.Namespace) -> int:
    from flockd.core.data import data_path

    file: Path = args.file
    if file.exists() and not args.force:
        raise UsageError(f"{file} exists; name another file, or overwrite it with --force")
    if not file.parent.is_dir():
        raise UsageError(f"{file.parent} is not a folder; make it first")
    folder = data_path("config")
    own = [("scenario", file.stem), ("drone", str(folder / "simulator.yaml"))] if args.kind == "scenario" else []
    template = folder / "templates" / f"{args.kind}.yaml"
    write_checked(file, template.read_text(encoding="utf-8"), [*own, *args.settings])
    return ExitCode.DONE


def write_checked(file: Path, text: str, settings: Sequence[tuple[str, str]] = ()) -> None:
    """Writes the file, with these values by key, if it checks, else leaves all as it was. Raises UsageError.

    The draft stands beside it: paths count from there.
    """
    from flockd.sim.scenario import load

    draft = file.with_name(f".{file.name}.draft.yaml")
    try:
        draft.write_text(text, encoding="utf-8")
        for key, value in settings:
            _set(draft, key, value)
        load(draft)
        draft.replace(file)
    except ConfigError as error:
        reasons = "; ".join(f"{problem.key}: {problem.message}" for problem in error.problems)
        raise UsageError(f"{file} was not written, as it would not check ({reasons}); change the options") from error
    finally:
        draft.unlink(missing_ok=True)
    say(f"{file}: written; `flockd config check {file}` checks it again after each change")


def _set(file: Path, key: str, value: str) -> None:
    """Changes the line of a key, or adds one below its section's; comments stay."""
    from flockd.core.config.document import KeyPath, read_document

    path: KeyPath = tuple(key.split("."))
    places, lines = read_document(file).places, file.read_text(encoding="utf-8").splitlines()
    there = next(length for length in range(len(path), -1, -1) if path[:length] in places)
    line = places[path[:there]].line if there else len(lines)
    if there == len(path):
        head = re.fullmatch(r"( *)([^#]*?:)( [^#]*?)?( *#.*)?", lines[line - 1])
        if head is None or head[2] != f"{path[-1]}:":
            raise UsageError(f"{key} shares its line of the template with others; write the file and change it there")
        end = line
        while end < len(lines) and lines[end].startswith(f"{head[1]} "):  # what the section held
            end += 1
        lines[line - 1 : end] = [f"{head[1]}{head[2]} {value}{head[4] or ''}"]
    else:
        sections = [f"{'  ' * depth}{path[depth]}:" for depth in range(there, len(path))]
        lines[line:line] = [*sections[:-1], f"{sections[-1]} {value}"]
    file.write_text("\n".join([*lines, ""]), encoding="utf-8")

"""`flockd config`: checks, shows and describes configuration files, and writes new ones."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.options import add_force, add_settings, permit, refuse_overwriting
from flockd.cli.output import complain, say, say_json, say_result
from flockd.cli.parser import Commands, commands_of, existing, flag, option
from flockd.core.errors import ConfigError, ConfigProblem, ExitCode, ModelError, UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from flockd.core.config import DroneConfig
    from flockd.core.config.document import KeyPath, Place

CHANGE_ME = "CHANGE-ME"
"""Stands in a new file for what only its owner knows."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples: tuple[str, ...] = (
        "flockd config check config/paper_flight.yaml",
        "flockd config show config/simulator.yaml",
        "flockd config new scenario my_flight.yaml --set duration_s=30",
    )
    commands = commands_of(commands("config", "Check, show, describe and write configuration files.", examples))
    examples = ("flockd config check my_flight.yaml", "flockd config check --json config/*.yaml")
    parser = commands("check", "Report all errors in files of drones, scenarios and campaigns.", examples, _check)
    parser.add_argument(
        "files", nargs="+", metavar="FILE", type=existing, help="a drone's, scenario's or campaign's file"
    )
    flag(parser, "--json", "print the problems as JSON")
    add_force(parser)
    examples = ("flockd config show config/paper_flight.yaml", "flockd config show --json config/simulator.yaml")
    parser = commands("show", "Show a file with every default filled in, a scenario with its drone.", examples, _show)
    option(parser, "FILE", "a drone's or a scenario's file", existing)
    flag(parser, "--json", "print JSON instead of YAML")
    examples = ("flockd config schema drone", "flockd config schema scenario > scenario.schema.json")
    description = "Print the JSON schema of a kind of file, for editors and other tools."
    parser = commands("schema", description, examples, _schema)
    parser.add_argument("kind", choices=("drone", "scenario", "campaign"), help="kind of file")
    examples = ("flockd config card my_drone.yaml", "flockd config card /etc/flockd/drone.yaml > card.md")
    description = "Print the card of a flight day, as Markdown: limits, heights, reactions to faults, people's tasks."
    option(commands("card", description, examples, _card), "FILE", "a drone's file", existing)
    examples = (
        "flockd config new drone my_drone.yaml --set name=kite2 --set safety.first_flight_layer=2",
        "flockd config new scenario woods.yaml --set world.obstacles.kind=forest --set obstacles.enabled=true",
    )
    description = "Write a commented file of a real drone or a simulated flight, to be filled in."
    parser = commands("new", description, examples, _new)
    parser.add_argument("kind", choices=("drone", "scenario"), help="kind of file")
    option(parser, "FILE", "the file to write", Path)
    flag(parser, "--force", "overwrite the file if it exists")
    add_settings(parser, "write this value")


def _card(args: argparse.Namespace) -> int:
    from flockd.core.config import load_real_drone
    from flockd.ground.flight_card import card

    say(card(load_real_drone(args.file)[0]).rstrip())
    return ExitCode.DONE


def _check(args: argparse.Namespace) -> int:
    results: dict[str, ConfigError | None] = {}
    for file in args.files:
        try:
            _check_file(file, force=args.force)
        except ConfigError as error:
            results[str(file)] = error
        else:
            results[str(file)] = None
    failed = [error for error in results.values() if error is not None]
    problems = sorted({problem for error in failed for problem in error.problems})
    if args.json:
        say_json({"ok": not failed, "problems": [asdict(problem) for problem in problems]})
        return ExitCode.BAD_CONFIGURATION if failed else ExitCode.DONE
    for file, fault in results.items():
        if fault is None:
            say(f"{file}: fine")
    if failed:
        raise ConfigError(problems)
    return ExitCode.DONE


def _check_file(file: Path, *, force: bool) -> None:
    """Raises ConfigError for what is wrong with the file, and for models and devices that are yet to be named.

    Of a real drone also for what is outside the proven envelope, unless that is forced.
    """
    from flockd.core.config import outside_envelope
    from flockd.core.config.document import read_document
    from flockd.core.config.loader import kind_of
    from flockd.flight.inference.manifest_file import manifest_path, models_folder, models_for, read_manifest
    from flockd.sim.scenario import ScenarioConfig, load_with_places

    if kind_of(read_document(file)) == "campaign":
        from flockd.campaign.flight_plan import Plan

        Plan.load(file)
        return
    config, places = load_with_places(file)
    section: KeyPath = ("drone", "perception") if isinstance(config, ScenarioConfig) else ("perception",)
    perception = config.drone.perception if isinstance(config, ScenarioConfig) else config.perception

    def problem(key: str, message: str) -> ConfigProblem:
        path: KeyPath = (*section, key)
        while path not in places:  # a default: the section's line, or the file's
            path = path[:-1]
        return replace(places[path].problem(message), key=".".join(("perception", key)))

    try:
        folder = models_folder(perception)
    except ModelError as error:
        raise ConfigError([problem("models_dir", str(error).partition(": ")[2])]) from error
    problems = []
    for role, name in perception.networks.items():
        path = manifest_path(folder, name)
        try:
            if not path.is_file():
                known = models_for(role, folder)
                hint = f"write one of {', '.join(known)}" if known else "name another"
                problems.append(problem(role, f"{name} is not a known model, as {path} is missing; {hint}"))
            elif role not in (roles := read_manifest(path).manifest.roles):
                problems.append(problem(role, f"{name} is for {', '.join(roles)}, not for {role}; name another"))
        except ModelError as error:
            problems.append(problem(role, f"names a model that cannot be used: {error}"))
    if not isinstance(config, ScenarioConfig):
        problems += [*_yet_to_fill_in(config, places), *_settings_of_zenoh(config, places)]
    if problems:
        raise ConfigError(problems)
    _warn_of_idle_keys(config.drone if isinstance(config, ScenarioConfig) else config, section[:-1], places)
    if isinstance(config, ScenarioConfig):
        for sentence in config.warnings():
            complain(f"warning: {file}: {sentence}")
    else:
        from flockd.ground.doctor import Level
        from flockd.ground.doctor.camera_checks import coverage, lens_problems, uncalibrated

        permit(outside_envelope(config, places), force=force)
        lenses = (one for camera in config.rig.cameras for one in lens_problems(camera))
        for finding in (
            one for one in (*uncalibrated(config), coverage(config.rig), *lenses) if one.level is not Level.PASS
        ):
            complain(f"warning: {file}: {finding.about}: {finding.measured}; {finding.fix}")


def _warn_of_idle_keys(config: DroneConfig, section: KeyPath, places: Mapping[KeyPath, Place]) -> None:
    """``section``: of the drone in the file."""
    for key, why in config.idle_keys().items():
        if (place := places.get((*section, *key))) is not None:
            complain(f"warning: {place.problem(f'has no effect, as {why}; delete it, or change that')}")


def _yet_to_fill_in(config: DroneConfig, places: Mapping[KeyPath, Place]) -> list[ConfigProblem]:
    """The devices that `flockd config new drone` could not know."""
    fault = f"is yet to be filled in ({CHANGE_ME}); `flockd cameras --write FILE` writes the cameras that it finds"
    cameras = () if config.source is None else config.source.cameras
    return [
        places["source", "cameras", number, "device"].problem(fault)
        for number, camera in enumerate(cameras)
        if camera.device and CHANGE_ME in camera.device
    ]


def _settings_of_zenoh(config: DroneConfig, places: Mapping[KeyPath, Place]) -> list[ConfigProblem]:
    from flockd.onboard.telemetry.zenoh_session import SettingsError, read_settings

    if config.telemetry.zenoh_config is None:
        return []
    try:
        read_settings(Path(config.telemetry.zenoh_config))
    except SettingsError as error:
        return [places["telemetry", "zenoh_config"].problem(str(error))]
    return []


def _show(args: argparse.Namespace) -> int:
    import yaml

    from flockd.sim.scenario import load

    values = load(args.file).model_dump(mode="json")
    text = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100)
    return say_result(args, values, text.rstrip())


def _schema(args: argparse.Namespace) -> int:
    from flockd.campaign.campaign_file import CampaignConfig
    from flockd.core.config import DroneConfig
    from flockd.sim.scenario import scenario_schema

    kinds = {"drone": DroneConfig.model_json_schema, "campaign": CampaignConfig.model_json_schema}
    say_json(kinds.get(args.kind, scenario_schema)())
    return ExitCode.DONE


def _new(args: argparse.Namespace) -> int:
    from flockd.core.data import data_path

    file: Path = args.file
    refuse_overwriting(args, file)
    folder = data_path("config")
    own = [("scenario", file.stem), ("drone", str(folder / "simulator.yaml"))] if args.kind == "scenario" else []
    template = folder / "templates" / f"{args.kind}.yaml"
    write_checked(file, template.read_text(encoding="utf-8"), [*own, *args.settings])
    return ExitCode.DONE


def write_checked(file: Path, text: str, settings: Sequence[tuple[str, str]] = ()) -> None:
    """Writes a configuration with these values by key. Raises UsageError, and changes nothing, where it is not valid.

    The draft is in the same folder, from which relative paths count.
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
    lines = file.read_text(encoding="utf-8").lower().splitlines()
    marked = [str(number) for number, line in enumerate(lines, 1) if "# fill in:" in line]
    left = f"fill in what the lines {', '.join(marked)} ask for; " if marked else ""
    say(f"{file}: written; {left}`flockd config check {file}` checks it after each change")


def _set(file: Path, key: str, value: str) -> None:
    """Changes the line of a key, or adds one below its section's; comments stay. Raises ConfigError inside a list."""
    from flockd.core.config.document import read_document
    from flockd.core.config.loader import override

    path: KeyPath = tuple(key.split("."))
    document, lines = read_document(file), file.read_text(encoding="utf-8").splitlines()
    places = dict(document.places)
    override(document, {key: value})  # refuses what cannot be set
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

"""`flockd config`: checks, shows and describes configuration files."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli import config_new
from flockd.cli.config_new import CHANGE_ME
from flockd.cli.output import say, say_json
from flockd.cli.parser import Commands, add_commands
from flockd.cli.real_drone import add_force, permit
from flockd.core.errors import ConfigError, ConfigProblem, ExitCode, ModelError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from flockd.core.config import DroneConfig
    from flockd.core.config.document import KeyPath, Place


def add(commands: Commands) -> None:
    """Adds the command."""
    examples = (
        "flockd config check config/paper_flight.yaml",
        "flockd config show config/simulator.yaml",
        "flockd config new scenario my_flight.yaml --set duration_s=30",
    )
    parser = commands("config", "Check, show, describe and begin configuration files.", examples)
    add_commands(parser, (_add_check, _add_show, _add_schema, _add_card, config_new.add))


def _add_check(commands: Commands) -> None:
    examples = ("flockd config check my_flight.yaml", "flockd config check --json config/*.yaml")
    parser = commands("check", "Report all errors in files of drones, scenarios and campaigns.", examples)
    parser.add_argument("files", nargs="+", metavar="FILE", type=Path, help="of drones, scenarios or campaigns")
    parser.add_argument("--json", action="store_true", help="print the problems as JSON")
    add_force(parser)
    parser.set_defaults(run=_check)


def _add_show(commands: Commands) -> None:
    examples = ("flockd config show config/paper_flight.yaml", "flockd config show --json config/simulator.yaml")
    parser = commands("show", "Show a file with every default filled in, a scenario with its drone.", examples)
    parser.add_argument("file", metavar="FILE", type=Path, help="of a drone or a scenario")
    parser.add_argument("--json", action="store_true", help="print JSON instead of YAML")
    parser.set_defaults(run=_show)


def _add_schema(commands: Commands) -> None:
    examples = ("flockd config schema drone", "flockd config schema scenario > scenario.schema.json")
    parser = commands("schema", "Print the JSON schema of a kind of file, for editors and other tools.", examples)
    parser.add_argument("kind", choices=("drone", "scenario", "campaign"), help="of the file")
    parser.set_defaults(run=_schema)


def _add_card(commands: Commands) -> None:
    examples = ("flockd config card my_drone.yaml", "flockd config card /etc/flockd/drone.yaml > card.md")
    description = "Print the card of a flight day, as Markdown: limits, heights, what each fault does, who does what."
    parser = commands("card", description, examples)
    parser.add_argument("file", metavar="FILE", type=Path, help="of a drone")
    parser.set_defaults(run=_card)


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
        problems += _yet_to_fill_in(config, places)
    if problems:
        raise ConfigError(problems)
    if not isinstance(config, ScenarioConfig):
        permit(outside_envelope(config, places), force=force)


def _yet_to_fill_in(config: DroneConfig, places: Mapping[KeyPath, Place]) -> list[ConfigProblem]:
    """The devices that `flockd config new drone` could not know."""
    fault = f"is yet to be filled in ({CHANGE_ME}); `flockd cameras --write FILE` writes what is plugged in"
    cameras = () if config.source is None else config.source.cameras
    return [
        places["source", "cameras", number, "device"].problem(fault)
        for number, camera in enumerate(cameras)
        if camera.device and CHANGE_ME in camera.device
    ]


def _show(args: argparse.Namespace) -> int:
    import yaml

    from flockd.sim.scenario import load

    values = load(args.file).model_dump(mode="json")
    if args.json:
        say_json(values)
    else:
        say(yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100).rstrip())
    return ExitCode.DONE


def _schema(args: argparse.Namespace) -> int:
    from flockd.campaign.campaign_file import CampaignConfig
    from flockd.core.config import DroneConfig
    from flockd.sim.scenario import scenario_schema

    kinds = {"drone": DroneConfig.model_json_schema, "campaign": CampaignConfig.model_json_schema}
    say_json(kinds.get(args.kind, scenario_schema)())
    return ExitCode.DONE


def loaded(file: Path | None) -> DroneConfig | None:
    """The drone of --config, which may also name a scenario. Raises ConfigError."""
    from flockd.sim.scenario import ScenarioConfig, load

    if file is None:
        return None
    config = load(file)
    return config.drone if isinstance(config, ScenarioConfig) else config

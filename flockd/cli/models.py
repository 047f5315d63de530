"""`flockd models`: which networks are at hand, and whether they are whole."""

from __future__ import annotations

import argparse
from pathlib import Path

from flockd.cli.output import say, say_json
from flockd.cli.parser import Commands, Parser, add_commands
from flockd.errors import ExitCode, ModelError, UnavailableError

THREADS = 2


def add(commands: Commands) -> None:
    """Adds the command."""
    parser = commands("models", "List and verify the networks.", ("flockd models list", "flockd models verify"))
    add_commands(parser, (_add_list, _add_verify))


def _add_list(commands: Commands) -> None:
    examples = ("flockd models list", "flockd models list --json", "flockd models list --dir my_models")
    _add_options(commands("list", "List each model with its roles.", examples)).set_defaults(run=_list)


def _add_verify(commands: Commands) -> None:
    examples = ("flockd models verify", "flockd models verify --json")
    description = "Check each model file against its manifest: hash, inputs, outputs and the answer to a known input."
    _add_options(commands("verify", description, examples)).set_defaults(run=_verify)


def _add_options(parser: Parser) -> Parser:
    parser.add_argument("--dir", type=Path, help="folder of the manifests; by default the one that comes with flockd")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _list(args: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table

    from flockd.perception.manifest import load_manifest

    models = [load_manifest(path)[0] for path in _manifests(args.dir)]
    if args.json:
        say_json([model.model_dump(mode="json") for model in models])
        return ExitCode.DONE
    table = Table("model", "roles", "file", "licence", "what it is", box=None, pad_edge=False)
    for model in models:
        table.add_row(model.name, ", ".join(model.roles), model.file, model.licence, model.description)
    Console(markup=False, highlight=False).print(table)
    return ExitCode.DONE


def _verify(args: argparse.Namespace) -> int:
    from flockd.perception.session import OnnxModel

    faults: dict[str, str | None] = {}
    for path in _manifests(args.dir):
        try:
            OnnxModel(path, threads=THREADS)
        except ModelError as error:
            faults[path.stem] = str(error)
        else:
            faults[path.stem] = None
    if args.json:
        say_json([{"model": name, "ok": fault is None, "fault": fault} for name, fault in faults.items()])
    else:
        for name, fault in faults.items():
            say(f"{name}: fine" if fault is None else fault)
    return ExitCode.CHECK_FAILED if any(faults.values()) else ExitCode.DONE


def _manifests(folder: Path | None) -> tuple[Path, ...]:
    from flockd.data import data_path
    from flockd.perception.manifest import find_manifests

    folder = folder or data_path("models")
    manifests = find_manifests(folder)
    if not manifests:
        raise UnavailableError(f"{folder} holds no model manifests; name the folder that does with --dir")
    return manifests

"""`flockd models`: lists, checks, prepares and imports networks."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.options import loaded
from flockd.cli.output import complain, noted_table, progress, say, say_facts, say_json, tables_console
from flockd.cli.parser import Commands, Parser, commands_of, existing, flag, option
from flockd.core.errors import ExitCode, ModelError, UnavailableError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig

THREADS = 2
_IMPORT = "flockd models import best.onnx --drone drone --licence AGPL-3.0"


def add(commands: Commands) -> None:
    """Adds the command."""
    examples: tuple[str, ...] = (
        "flockd models list", "flockd models verify", "flockd models prepare --config my_drone.yaml", _IMPORT
    )  # fmt: skip
    commands = commands_of(commands("models", "List, verify, prepare and import networks.", examples))
    examples = ("flockd models list", "flockd models list --json", "flockd models list --dir my_models")
    _add_options(commands("list", "List each model with its roles; a damaged one is refused.", examples, _list))
    examples = ("flockd models verify", "flockd models verify --json")
    description = "Check each model file against its manifest: hash, weights, inputs, outputs, and golden output."
    _add_options(commands("verify", description, examples, _verify))
    examples = ("flockd models prepare --config my_drone.yaml", "flockd models prepare --config my_drone.yaml --json")
    description = (
        "Build the engines of a drone's models before the flight. TensorRT takes minutes, and a flight without its "
        "engines is refused; OpenVINO starts sooner with them; CPU and CUDA need no engines."
    )
    parser = commands("prepare", description, examples, _prepare)
    option(parser, "--config FILE", "the drone's configuration", existing, required=True)
    flag(parser, "--json", "print JSON")
    description = (
        "Import a detector of your own for `perception.detector`: ONNX of a fixed size, as Ultralytics (YOLOv5, v8, "
        "11, 26) or YOLOX export it. Writes a copy that decodes its boxes, and its manifest; FILE stays as it is."
    )
    parser = commands("import", description, (_IMPORT,), _import)
    option(parser, "FILE", "the ONNX file", existing)
    option(parser, "--drone CLASS", "the class of drones, by its name in FILE or its number from 0", required=True)
    told = "licence of the weights, for the manifest; networks trained with Ultralytics are under AGPL-3.0"
    option(parser, "--licence TEXT", told)
    option(parser, "--out FOLDER", "folder to write into (default: my_models)", Path, default=Path("my_models"))
    flag(parser, "--force", "overwrite existing files")
    flag(parser, "--json", "print JSON")


def _add_options(parser: Parser) -> Parser:
    option(parser, "--dir", "folder of the manifests (default: flockd's own)", existing)
    flag(parser, "--json", "print JSON")
    return parser


def _list(args: argparse.Namespace) -> int:
    from flockd.flight.inference import load_manifest

    models = [load_manifest(path) for path in _manifests(args.dir)]
    if args.json:
        say_json([model.model_dump(mode="json") for model, _ in models])
        return ExitCode.DONE
    rows = [
        (
            (model.name, ", ".join(model.roles), f"{file.stat().st_size / 1e6:.1f}", model.sha256[:12], model.licence),
            [model.description],
        )
        for model, file in models
    ]
    tables_console().print(noted_table(("model", "roles", "MB", "sha256", "licence"), rows))
    return ExitCode.DONE


def _verify(args: argparse.Namespace) -> int:
    from flockd.flight.inference import OnnxModel
    from flockd.onboard.worker import GOLDEN_S, within

    faults: dict[str, str | None] = {}
    for path in _manifests(args.dir):
        try:
            OnnxModel(path, threads=THREADS, deadline=within(GOLDEN_S))
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


def _import(args: argparse.Namespace) -> int:
    from flockd.ground.detector_import import import_detector

    made = import_detector(args.file, args.drone, args.licence, args.out, overwrite=args.force)
    if made.terms:
        complain(
            f"{args.file} says {made.terms!r}: whoever gets a drone, or uses a service, with this network may ask for "
            "the source of the whole program; give it, or get another licence from Ultralytics"
        )
    complain(
        "write it as perception.detector in a drone's file; try it: flockd detect PICTURES --config FILE --fov DEG"
    )
    facts = {"manifest": str(made.manifest), "kind": made.kind, "drone": made.drone, "classes": made.classes}
    return say_facts(args, facts)


def _prepare(args: argparse.Namespace) -> int:
    from flockd.flight.inference import manifests_of

    config = loaded(args.config)
    assert config is not None
    paths = manifests_of(config.perception)
    prepared = []
    with progress("preparing", "models") as tell:
        for path in paths:
            prepared.append(_prepare_one(path, config))
            tell(len(prepared), len(paths))
    return say_facts(args, prepared)


def _prepare_one(path: Path, config: DroneConfig) -> dict[str, Any]:
    """Runs a model on every shape of input that these cameras give it, keeps the engines, and opens it as in flight."""
    from flockd.flight.inference import OnnxModel
    from flockd.flight.inference.feeds import feeds_for, golden_feeds, shapes_of
    from flockd.flight.inference.providers import BUILD_ENGINES, Prepared, engines_folder
    from flockd.flight.perception.onnx import CROPS_PER_RUN

    wanted = config.perception
    options: Any = {
        "threads": wanted.threads,
        "provider": wanted.provider,
        "engines": engines_folder(wanted),
    }
    begun_s = time.perf_counter()
    if wanted.provider in BUILD_ENGINES:
        model = OnnxModel(path, **options, preparing=True)
        sizes = sorted({camera.size_px for camera in config.rig.cameras})
        feeds = [
            golden_feeds(model.manifest),
            *(feeds_for(model.manifest, size, batch) for size in sizes for batch in (1, CROPS_PER_RUN)),
        ]
        for each in feeds:
            model.run(each)
        if model.engines is not None:
            Prepared([shapes_of(each) for each in feeds]).save(model.engines)
        del model  # some providers write their cache when a session ends
    prepared_s = time.perf_counter()
    engines = OnnxModel(path, **options).engines
    return {
        "model": path.stem,
        "provider": wanted.provider,
        "engines": None if engines is None else str(engines),
        "prepare_s": prepared_s - begun_s,
        "start_s": time.perf_counter() - prepared_s,
    }


def _manifests(folder: Path | None) -> tuple[Path, ...]:
    from flockd.core.data import data_path
    from flockd.flight.inference import find_manifests

    folder = folder or data_path("models")
    manifests = find_manifests(folder)
    if not manifests:
        raise UnavailableError(f"{folder} holds no model manifests; name the folder that does with --dir")
    return manifests

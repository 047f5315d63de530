"""`flockd models`: which networks there are, whether they are intact, how fast they are, and their engines."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockd.cli.options import loaded
from flockd.cli.output import noted_table, progress, say, say_facts, say_json, say_table, tables_console
from flockd.cli.parser import Commands, Parser, commands_of, flag, option, positive_count, size
from flockd.core.choices import PROVIDERS, Provider
from flockd.core.errors import ExitCode, ModelError, UnavailableError, UsageError

if TYPE_CHECKING:
    from flockd.core.config import DroneConfig
    from flockd.flight.inference import OnnxModel

THREADS = 2
LEAST_PX = 32
RUNS = 9
"""Timed after one run that is not counted."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples: tuple[str, ...] = (
        "flockd models list", "flockd models verify", "flockd models bench --threads 1,2"
    )  # fmt: skip
    commands = commands_of(commands("models", "List, verify, time and prepare the networks.", examples))
    examples = ("flockd models list", "flockd models list --json", "flockd models list --dir my_models")
    _add_options(commands("list", "List each model with its roles; a damaged one is refused.", examples, _list))
    examples = ("flockd models verify", "flockd models verify --json")
    description = "Check each model file against its manifest: hash, weights, inputs, outputs, and golden output."
    _add_options(commands("verify", description, examples, _verify))
    examples = (
        "flockd models bench",
        "flockd models bench --threads 1,2,4 --size 640x480 --json",
        "flockd models bench --dir models_of_others --provider cuda",
    )
    description = "Time each model, for each provider and number of threads: milliseconds a run, the median."
    parser = _add_options(commands("bench", description, examples, _bench))
    option(parser, "--provider NAME,...", f"{', '.join(PROVIDERS)} (default: all that are installed)")
    option(
        parser,
        "--threads N,...",
        "on the CPU (default: 1,2)",
        lambda text: tuple(map(positive_count, text.split(","))),
        default=(1, 2),
    )
    option(parser, "--size WxH", "of the image (default: 640x480)", size, default=(640, 480))
    option(parser, "--runs N", f"to time (default: {RUNS})", positive_count, default=RUNS)
    examples = ("flockd models prepare --config my_drone.yaml", "flockd models prepare --config my_drone.yaml --json")
    description = (
        "Build what a drone's provider needs for its models and cameras, ahead of flight. TensorRT takes minutes, and "
        "a flight with it is refused before; OpenVINO starts sooner; CPU and CUDA have nothing to build."
    )
    parser = commands("prepare", description, examples, _prepare)
    option(parser, "--config FILE", "the drone's configuration", Path, required=True)
    flag(parser, "--json", "print JSON")


def _add_options(parser: Parser) -> Parser:
    option(parser, "--dir", "folder of the manifests; by default the one that comes with flockd", Path)
    flag(parser, "--json", "print JSON")
    return parser


def _list(args: argparse.Namespace) -> int:
    from flockd.flight.inference import load_manifest
    from flockd.flight.perception.requirements import check_roles

    models = [load_manifest(path, check_roles) for path in _manifests(args.dir)]
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
    from flockd.flight.perception.requirements import check_roles
    from flockd.onboard.worker import GOLDEN_S, within

    faults: dict[str, str | None] = {}
    for path in _manifests(args.dir):
        try:
            OnnxModel(path, threads=THREADS, check=check_roles, deadline=within(GOLDEN_S))
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


@dataclass(frozen=True)
class _Timing:
    model: str
    provider: str
    threads: int
    input: str
    """What enters, as in `first 1x120x160x3`."""
    median_ms: float | None
    least_ms: float | None
    fault: str | None
    """Why it does not run there."""


def _bench(args: argparse.Namespace) -> int:
    if min(args.size) < LEAST_PX:
        raise UsageError(f"--size: networks take images of at least {LEAST_PX}x{LEAST_PX}; name a larger one")
    timings = []
    providers = _providers(args.provider)
    manifests = _manifests(args.dir)
    with progress("timing", "combinations") as tell:
        for timing in _timings(manifests, providers, args):
            timings.append(timing)
            tell(len(timings), len(manifests) * len(providers) * len(args.threads))
    if args.json:
        say_json([asdict(timing) for timing in timings])
    else:
        rows = []
        for t in timings:
            cells = [f"{t.median_ms:.1f}", f"{t.least_ms:.1f}", t.input] if t.fault is None else ["-", "-", t.fault]
            rows.append([t.model, t.provider, str(t.threads), *cells])
        say_table(("model", "provider", "threads", "ms, median", "least", "input"), rows)
    return ExitCode.CHECK_FAILED if any(timing.fault for timing in timings) else ExitCode.DONE


def _providers(text: str | None) -> Sequence[Provider]:
    from flockd.flight.inference.providers import available

    if text is None:
        return available()
    named = [provider for provider in PROVIDERS if provider in text.split(",")]
    unknown = sorted(set(text.split(",")) - set(PROVIDERS))
    if unknown:
        raise UsageError(f"--provider: {unknown[0]!r} is none of {', '.join(PROVIDERS)}; choose one of these")
    return named


def _timings(manifests: Sequence[Path], providers: Sequence[Provider], args: argparse.Namespace) -> Iterator[_Timing]:
    from flockd.flight.inference import OnnxModel
    from flockd.flight.inference.feeds import feeds_for, shapes_of
    from flockd.flight.perception.requirements import check_roles

    for path in manifests:
        for provider in providers:
            for threads in args.threads:
                try:
                    model = OnnxModel(path, threads=threads, provider=provider, preparing=True, check=check_roles)
                except ModelError as error:
                    yield _Timing(path.stem, provider, threads, "", None, None, str(error))
                    continue
                feeds = feeds_for(model.manifest, args.size)
                taken_ms = sorted(_times_ms(model, feeds, args.runs))
                entered = ", ".join(f"{n} {'x'.join(map(str, shape))}" for n, shape in shapes_of(feeds).items())
                yield _Timing(path.stem, provider, threads, entered, statistics.median(taken_ms), taken_ms[0], None)


def _times_ms(model: OnnxModel, feeds: Any, runs: int) -> list[float]:
    model.run(feeds)
    times = []
    for _ in range(runs):
        begun_s = time.perf_counter()
        model.run(feeds)
        times.append(1e3 * (time.perf_counter() - begun_s))
    return times


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
    from flockd.flight.inference.providers import builds_engines, engines_folder
    from flockd.flight.perception.onnx import CROPS_PER_RUN
    from flockd.flight.perception.requirements import check_roles

    wanted = config.perception
    options: Any = {
        "threads": wanted.threads,
        "provider": wanted.provider,
        "engines": engines_folder(wanted),
        "check": check_roles,
    }
    begun_s = time.perf_counter()
    if builds_engines(wanted.provider):
        model = OnnxModel(path, **options, preparing=True)
        sizes = sorted({camera.size_px for camera in config.rig.cameras})
        feeds = [
            golden_feeds(model.manifest),
            *(feeds_for(model.manifest, size, batch) for size in sizes for batch in (1, CROPS_PER_RUN)),
        ]
        for each in feeds:
            model.run(each)
        model.keep_engines([shapes_of(each) for each in feeds])
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

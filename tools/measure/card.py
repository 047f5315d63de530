"""Measure every published figure and write docs/figures.json, from which `tools.docs.figures` writes the pages.

python -m tools.measure.card --quick            # for who changes something: flights of 20 minutes on two cores
python -m tools.measure.card                    # for a release: some 30 hours on two cores
python -m tools.measure.card --parts px4 step   # these again; the others stay as they were measured, with their commit
python -m tools.measure.card --parts flights --scenarios forest    # of the flights these alone

`flights`: the published scenarios on seeds that follow from the commit's hash, so that nobody can have tuned to them.
Beside each flight by sight stand, on the same seed, a blind one, whose drones detect nobody, and an exact one, on the
true states of all: what the blind flock matches is no achievement. A run that was stopped goes on: RESULTS/COMMIT-*
has a line for each flight, and the logs of those by sight. `errors`: what drones perceive wrongly in these flights,
for config/perceived. `encounters`: two drones that meet on made-up detections with such errors. `pictures`: real ones,
with --labelled and --without-drones. `px4` and `px4_stories` (of faults): where FLOCKD_PX4 names a build. `step`: on
this computer.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import math
import multiprocessing
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml
from scipy.stats import binom

from flockd.campaign.figures import MEASURES, Figure, figures_of
from flockd.campaign.flight_plan import CASE
from flockd.campaign.results import Results
from flockd.core.choices import SimulatedPerception
from flockd.core.config.document import Value
from flockd.core.config.loader import Overrides
from flockd.core.data import data_path
from flockd.flight.inference.manifest_file import model_hashes
from flockd.review.replay.profile import ComputerFiles
from flockd.sim.cameras.camera_simulator import family_of
from flockd.sim.flock.swarm import fly
from flockd.sim.renderer.airframe import DroneModel
from flockd.sim.scenario import MIN_START_DISTANCE_M, ScenarioConfig, load_scenario
from tools.measure import perceived_errors
from tools.measure.labelled import Box, read_labels, scored
from tools.measure.trouble import trouble
from tools.training.own_mesh import painted, read_meshes

ROOT = Path(__file__).resolve().parents[2]
FIGURES_FILE = ROOT / "docs" / "figures.json"
PERCEIVED = ROOT / "config" / "perceived" / "shipped_networks.yaml"
SEEDS = 1_000_000
"""Seeds of flights are below this; those of training worlds are above (`tools.training.worlds`)."""
CONFIDENCE = 0.95
FIGURES: tuple[Figure, ...] = (
    "min_distance_after_10s_m", "order_tail", "shape_deviation_tail", "convergence_time_s", "recall_within_10m",
    "false_share", "associated_error_median_m", "associated_error_p95_m", "associated_error_max_m",
    "distance_error_median_m", "distance_error_p95_m", "slowed_share", "drones_held", "collisions", "min_distance_m",
)  # fmt: skip


@dataclass(frozen=True)
class Eyes:
    """How drones know each other."""

    perception: SimulatedPerception
    overrides: Overrides = field(default_factory=dict)


EYES = {
    "sight": Eyes("learned"),
    "blind": Eyes("truth", {"detections.missed": 1.0}),
    "exact": Eyes("truth"),
}


Airframe = tuple[str, float]
"""File of the mesh, and the size in metres from propeller tip to tip."""


@dataclass(frozen=True)
class Scenario:
    """What is flown, how often, and for how long; `quick` and `whole`: flights and seconds, None: the file's."""

    file: str
    quick: tuple[int, float | None]
    whole: tuple[int, float | None] = (20, None)
    troubled: bool = False
    """Something happens to one of five that fly in formation: see `tools.measure.trouble`."""
    varied: bool = False
    """Any airframe, the two that no network learnt among them; trees and houses nearer; wind with gusts; and in two
    of three flights a drone is taken over by its autopilot, which holds or lands."""

    def overrides(self, seed: int, turn: int, airframe: Airframe | None = None) -> Overrides:
        """Overrides of the file for the flight with this seed and number."""
        if airframe is not None:
            return {**self.overrides(seed, turn), "drone.perception.drone_size_m": airframe[1]}
        if self.troubled:
            return trouble(seed, turn)
        if not self.varied:
            return {}
        wind, after = 2.0 * math.cos(seed), 8.0 + seed % 7
        takeover: Value = {"drone": 1 + seed % 5, "time_s": after, "to": ("hold", "land")[seed % 2]}
        return {
            "world.drone_family": "any", "world.clearance_m": 6.0, "vehicle.wind_m_s": (wind, 2.0 * math.sin(seed)),
            "vehicle.gust_m_s": 0.15, "takeovers": (takeover,) if seed % 3 else (),
        }  # fmt: skip


REAL_AIRFRAMES = "varied, real airframes"
"""Flown with the meshes of `--airframe` in turn; their size is given, as in a drone's file."""
SCENARIOS = {
    "the paper's five drones": Scenario("paper_flight.yaml", (2, 30.0)),
    "varied": Scenario("paper_flight.yaml", (3, 20.0), varied=True),
    "one of five in trouble": Scenario("paper_flight.yaml", (4, 15.0), (21, 18.0), troubled=True),
    "forest": Scenario("forest.yaml", (1, 20.0)),
    "fisheye": Scenario("fisheye_flight.yaml", (1, 15.0)),
    "head-on": Scenario("head_on.yaml", (6, None)),
    REAL_AIRFRAMES: Scenario("paper_flight.yaml", (3, 20.0), (10, None), varied=True),
}


@dataclass(frozen=True)
class Flight:
    """One flight of the list."""

    scenario: str
    eyes: str
    seed: int
    file: str
    duration_s: float | None
    overrides: Overrides
    airframe: Airframe | None = None

    @property
    def key(self) -> tuple[str, str, int]:
        """Identifies the flight in a run."""
        return self.scenario, self.eyes, self.seed

    @property
    def log_name(self) -> str:
        """Name of the log's file, of a flight by sight."""
        return f"{self.scenario.replace(' ', '_')}-{self.seed}.npz"

    def models(self) -> list[DroneModel] | None:
        """The airframe, painted differently for each drone; None: as the scenario says."""
        if self.airframe is None:
            return None
        file, size_m = self.airframe
        shapes = read_meshes([Path(file)], size_m)
        return [painted(shapes[0], self.seed + k) for k in range(len(self.flown().vehicles))]

    def flown(self) -> ScenarioConfig:
        """The scenario of the flight."""
        overrides: Overrides = {**self.overrides, "seed": self.seed, "drone.perception.threads": 1}
        if self.duration_s is not None:
            overrides = {**overrides, "duration_s": self.duration_s}
        return load_scenario(data_path("config") / self.file, overrides)


Line = dict[str, Any]
"""Of one flight: `scenario`, `eyes`, `seed`, `figures` (null where there is none), `wall_s`, and `failed`, the reason
why it could not be flown, or null."""


def flights_of(
    commit: str, *, quick: bool, most: int | None = None, airframes: Sequence[Airframe] = ()
) -> list[Flight]:
    """All flights of a run, those by sight first: they take longest. `most`: of each scenario."""
    found: list[Flight] = []
    for eyes, of in EYES.items():
        for name, scenario in SCENARIOS.items():
            worn: Sequence[Airframe | None] = airframes if name == REAL_AIRFRAMES else [None]
            count, duration_s = scenario.quick if quick else scenario.whole
            seeds = zip(seeds_of(commit, name, count)[:most], itertools.cycle(worn), strict=False)
            for turn, (seed, airframe) in enumerate(seeds):
                overrides = {**scenario.overrides(seed, turn, airframe), **of.overrides}
                found.append(Flight(name, eyes, seed, scenario.file, duration_s, overrides, airframe))
    return found


def seeds_of(commit: str, scenario: str, count: int) -> list[int]:
    """Seeds by hashes of commit, scenario and number: nobody chose them."""
    hashes = (hashlib.sha256(f"{commit} {scenario} {k}".encode()).digest() for k in range(count))
    return [int.from_bytes(one[:8]) % SEEDS for one in hashes]


def flown(flight: Flight, logs: Path | None = None) -> Line:
    """Fly it in this process. `failed` has the reason if it cannot be flown. A flight by sight leaves its log."""
    begin, reason, figures = time.monotonic(), None, dict[Figure, float | None]()
    try:
        perception, models = EYES[flight.eyes].perception, flight.models()
        log = fly(flight.flown(), perception=perception, models=models, threads=0, pictured=False).log
        figures = figures_of(log, FIGURES)
        if logs is not None and flight.eyes == "sight":
            log.save(logs / flight.log_name)
    except Exception as error:  # noqa: BLE001 - whatever it is, it is one flight's result
        reason = f"{type(error).__name__}: {error}"
    who = dict(zip(("scenario", "eyes", "seed"), flight.key, strict=True))
    return {**who, "figures": figures, "wall_s": round(time.monotonic() - begin, 1), "failed": reason}


def run(
    flights: Sequence[Flight], results: Path, workers: int, fly_one: Callable[[Flight], Line] | None = None
) -> list[Line]:
    """Fly what ``results`` lacks or has as failed, append it there, and return all lines."""
    lines = {_key(line): line for line in read_lines(results) if line["failed"] is None}
    missing = [flight for flight in flights if flight.key not in lines]
    fly_one = fly_one or partial(flown, logs=results.parent)
    results.parent.mkdir(parents=True, exist_ok=True)
    draft = results.with_suffix(".new")
    draft.write_text("".join(json.dumps(line) + "\n" for line in lines.values()), encoding="utf-8")
    draft.replace(results)
    with results.open("a", encoding="utf-8") as file:
        for done, line in enumerate(_each(missing, workers, fly_one), start=len(flights) - len(missing) + 1):
            file.write(json.dumps(line) + "\n")
            file.flush()
            lines[_key(line)] = line
            said = line["failed"] or f"{line['wall_s']:.0f} s"
            print(f"{done}/{len(flights)}: {line['scenario']}, {line['eyes']}, seed {line['seed']}: {said}", flush=True)
    return [lines[flight.key] for flight in flights]


def _each(flights: Sequence[Flight], workers: int, fly_one: Callable[[Flight], Line]) -> Iterator[Line]:
    if workers == 1:
        yield from map(fly_one, flights)
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        yield from (future.result() for future in as_completed([pool.submit(fly_one, one) for one in flights]))


def read_lines(results: Path) -> list[Line]:
    """The flights of a file of results, without an incomplete last line."""
    if not results.is_file():
        return []
    whole, _, _ = results.read_text(encoding="utf-8").rpartition("\n")
    return [json.loads(line) for line in whole.splitlines()]


def _key(line: Line) -> tuple[str, str, int]:
    return line["scenario"], line["eyes"], line["seed"]


def table_of(lines: Sequence[Line]) -> dict[str, Any]:
    """Of one scenario's lines, by eyes: how many flights, how many failed, each figure's `Spread` as a mapping, and the
    figures of each flight with its seed."""
    table: dict[str, Any] = {}
    for eyes in EYES:
        of_eyes = [line for line in lines if line["eyes"] == eyes]
        good = [line for line in of_eyes if line["failed"] is None]
        figures = {}
        for figure in FIGURES:
            known = [line["figures"][figure] for line in good if line["figures"].get(figure) is not None]
            if known:
                figures[figure] = spread(known, higher_is_better=MEASURES[figure].better == "higher")
        each = [{"seed": line["seed"], **_rounded_figures(line["figures"])} for line in good]
        table[eyes] = {"flights": len(of_eyes), "failed": len(of_eyes) - len(good), "figures": figures, "each": each}
    return table


def spread(values: Sequence[float], *, higher_is_better: bool) -> dict[str, Any]:
    """Median with its interval at 95 % (of ranks, by the binomial distribution; of few values the whole range), worst,
    and how many flights have a value."""
    ordered, n = sorted(values), len(values)
    rank = max(int(binom.ppf((1.0 - CONFIDENCE) / 2.0, n, 0.5)) - 1, 0)
    middle = (ordered[(n - 1) // 2] + ordered[n // 2]) / 2.0
    return {
        "median": _rounded(middle), "interval": [_rounded(ordered[rank]), _rounded(ordered[n - 1 - rank])],
        "worst": _rounded(ordered[0] if higher_is_better else ordered[-1]), "count": n,
    }  # fmt: skip


def _rounded(value: float) -> float:
    """To four digits."""
    return value if value == 0.0 else round(value, 3 - math.floor(math.log10(abs(value))))


def _rounded_figures(figures: dict[Figure, float | None]) -> dict[str, float]:
    return {figure: _rounded(value) for figure, value in figures.items() if value is not None}


def document(commit: str, lines: Sequence[Line], *, quick: bool, most: int | None = None) -> dict[str, Any]:
    """What docs/figures.json holds of each scenario's flights."""
    fewer = "" if most is None else f" --flights {most}"
    measured_by = _measured_by(commit, f"python -m tools.measure.card{' --quick' * quick} --parts flights{fewer}")
    found = {}
    for name, one in SCENARIOS.items():
        if of_scenario := [line for line in lines if line["scenario"] == name]:
            scenario = load_scenario(data_path("config") / one.file)
            found[name] = {
                **measured_by,
                "networks": model_hashes(scenario.drone.perception),
                "file": one.file,
                "flown_s": round(sum(line["wall_s"] for line in of_scenario)),
                "duration_s": (one.quick if quick else one.whole)[1] or scenario.duration_s,
                **table_of(of_scenario),
            }
    return found


def _measured_by(commit: str, command: str) -> dict[str, Any]:
    computer = ComputerFiles().computer()
    machine = f"{computer['name']}, {computer['cores']} cores, Python {platform.python_version()}"
    return {"commit": commit, "date": datetime.now(UTC).date().isoformat(), "command": command, "machine": machine}


def encounters(results: Results) -> list[dict[str, Any]]:
    """Of each speed and kind of airframe: how many flights, the nearest, and how many touched."""
    found, varied = [], "detections.airframe"
    for speed in sorted({str(case).rpartition("_")[2] for case in results.values_of(CASE)}):
        cases = [case for case in results.values_of(CASE) if str(case).endswith(f"_{speed}")]
        for airframe in results.values_of(varied):
            cells = {cell for case in cases for cell in results.cells_with({CASE: case, varied: airframe})}
            near_m = [row["min_distance_m"] for row in results.rows if row["cell"] in cells]
            known = sorted(metres for metres in near_m if metres is not None)
            found.append({
                "speed_m_s": float(speed), "airframe": airframe, "flights": len(known), "nearest_m": round(known[0], 2),
                "touched": sum(metres < MIN_START_DISTANCE_M for metres in known),
            })  # fmt: skip
    return found


def _pictures(labelled: Sequence[str], without_drones: Sequence[str]) -> dict[str, Any]:
    """What `flockd detect` finds in each set, NAME=FOLDER, of cameras of 90 degrees."""
    found: dict[str, Any] = {}
    for given in (*labelled, *without_drones):
        name, _, folder = given.partition("=")
        one = json.loads(_flockd("detect", folder, "--fov", "90", "--json"))
        pictures = one.pop("pictures")
        nowhere: dict[Path, list[Box]] = {Path(picture["file"]).resolve(): [] for picture in pictures}
        labels = read_labels(Path(folder) / "labels.json") if given in labelled else nowhere
        found[name] = one | scored(pictures, labels)
    return found


def _campaign(name: str, seeds: int | None, folder: Path, workers: int) -> Results:
    """Fly a campaign of config/campaigns with so many seeds, None: the file's; what is there already is kept."""
    path = data_path("config") / "campaigns" / f"{name}.yaml"
    document = yaml.safe_load(path.read_text(encoding="utf-8"))
    document["scenario"] = str((path.parent / document["scenario"]).resolve())
    document |= {} if seeds is None else {"seeds": seeds}
    folder.parent.mkdir(parents=True, exist_ok=True)
    copy = folder.with_suffix(".yaml")
    copy.write_text(yaml.safe_dump(document), encoding="utf-8")
    _flockd("campaign", "run", str(copy), "--out", str(folder), "--workers", str(workers))
    return Results.load(folder)


def _flockd(*words: str) -> str:
    """What a command of flockd prints."""
    return _output("-c", "from flockd import program; program()", *words)


def _output(*words: str) -> str:
    """The output of a Python program; its exit code may be 1."""
    ended = subprocess.run([sys.executable, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if ended.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(words)} ended with exit code {ended.returncode}")
    return ended.stdout


def _stories() -> dict[str, str]:
    """Outcome of each story of a fault with PX4: "passed", "failure", "error" or "skipped"."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "stories.xml"
        _output("-m", "pytest", "-q", "-m", "fault", "-k", "not fake", "tests/sitl", f"--junitxml={file}")
        cases = list(ElementTree.parse(file).iter("testcase"))
    told = {case.attrib["name"].removeprefix("test_"): [one.tag for one in case] for case in cases}
    return {
        name.replace("_", " "): next((tag for tag in ("failure", "error", "skipped") if tag in tags), "passed")
        for name, tags in told.items()
    }


def commit_of(root: Path) -> str:
    """The commit that is checked out. Raises SystemExit where what flies differs from it."""
    changed = git(root, "status", "--porcelain", "--", "flockd", "models", "config")
    if changed:
        raise SystemExit(f"flockd, models or config differ from the commit; commit first:\n{changed}")
    return git(root, "rev-parse", "HEAD")


def git(root: Path, *words: str) -> str:
    """What git prints in the folder `root`."""
    return subprocess.run(["git", *words], cwd=root, check=True, capture_output=True, text=True).stdout.strip()


def _part(part: str, commit: str, arguments: argparse.Namespace, known: dict[str, Any]) -> dict[str, Any]:
    """Measure one part. `known`: its earlier measurement, of which the scenarios that are not flown stay."""
    quick, workers, results = arguments.quick, arguments.workers, arguments.results / commit[:12]
    size = "quick" if quick else "whole"
    found: Any = None
    if part == "flights":
        most = arguments.flights
        airframes = [(str(Path(file).resolve()), float(size_m)) for file, size_m in arguments.airframe]
        flights = flights_of(commit, quick=quick, most=most, airframes=airframes)
        flights = [one for one in flights if one.scenario in arguments.scenarios]
        measured = document(commit, run(flights, results / f"{size}.jsonl", workers), quick=quick, most=most)
        return known | measured
    if part == "errors":
        logs = {path.stem: path for path in sorted(results.glob("*.npz"))}
        if not logs:
            raise SystemExit(f"{results} has no log of a flight by sight; fly them first, with `--parts flights`")
        by_sight = [one for one in flights_of(commit, quick=False, airframes=[("", 1.0)]) if one.eyes == "sight"]
        logged = {Path(one.log_name).stem: one for one in by_sight if Path(one.log_name).stem in logs}
        families = {
            name: perceived_errors.REAL if one.airframe else family_of(one.flown()) for name, one in logged.items()
        }
        scenarios = {name: (logs[name], one.flown()) for name, one in logged.items()}
        perceived_errors.write(scenarios, families, commit, PERCEIVED)
        found = {"logs": list(logs)}
    elif part == "encounters":
        found = encounters(_campaign("encounters", 18 if quick else None, results / f"encounters-{size}", workers))
    elif part == "pictures":
        found = _pictures(arguments.labelled, arguments.without_drones)
    elif part == "px4":
        found = [json.loads(line) for line in _output("-m", "tools.checks.px4_rows").splitlines()]
    elif part == "px4_stories":
        found = _stories()
    elif part == "step":
        recording = "tests/review/replay/crossing.mcap"
        found = json.loads(_flockd("replay", recording, "--profile", "--json"))
    return {**_measured_by(commit, f"python -m tools.measure.card{' --quick' * quick} --parts {part}"), "found": found}


PARTS = ("flights", "errors", "encounters", "pictures", "px4", "px4_stories", "step")


def main() -> None:
    """Measure what is asked for and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few and short flights")
    parser.add_argument("--parts", nargs="+", choices=PARTS, metavar="PART", help="default: all that can be measured")
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, default=list(SCENARIOS), metavar="SCENARIO")
    parser.add_argument("--flights", type=int, metavar="N", help="of each scenario; default: all of the list")
    parser.add_argument("--airframe", nargs=2, action="append", default=[], metavar=("GLB", "SIZE_M"))
    parser.add_argument("--results", type=Path, default=ROOT / "out" / "card", help="default: out/card")
    parser.add_argument("--out", type=Path, default=FIGURES_FILE, help="default: docs/figures.json")
    parser.add_argument("--labelled", action="append", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--without-drones", action="append", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="flights at once")
    arguments = parser.parse_args()
    commit = commit_of(ROOT)
    missing = set() if arguments.labelled or arguments.without_drones else {"pictures"}
    missing |= set() if "FLOCKD_PX4" in os.environ else {"px4", "px4_stories"}
    for part in arguments.parts or [part for part in PARTS if part not in missing]:
        known = json.loads(arguments.out.read_text(encoding="utf-8")) if arguments.out.is_file() else {}
        measured = _part(part, commit, arguments, known.get(part, {}))
        arguments.out.write_text(json.dumps(known | {part: measured}, indent=1) + "\n", encoding="utf-8")
        print(f"{arguments.out}: {part}", flush=True)


if __name__ == "__main__":
    main()

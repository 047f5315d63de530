"""Leave out single mechanisms of flockd/flight that are not the paper's equations, and compare flights by sight.

python -m tools.measure.ablate    # all of the list, ten seeds of each scenario: for many cores, or many nights
python -m tools.measure.ablate --only passing --scenarios varied head-on --seeds 3 --seconds 15

ablate.yaml lists them. Each flies in a copy of the package, on the same seeds as the package as it is; they follow from
the commit's hash. A run that was stopped goes on: RESULTS has a line for each flight. A stepped simulation is
deterministic: a difference of zero in all figures means that the mechanism did nothing. Else its mean over the seeds,
left out minus as it is, has an interval at 95 % by Student's t: one of forty intervals shows a loss that is none, and
few seeds show only large losses. What shows no loss on ten fresh seeds of all scenarios goes, if nothing else asks for
it: a `note` says what these flights cannot judge.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import yaml

import flockd
from flockd.campaign.figures import MEASURES, Figure, mean_interval
from tools.checks.breakages import StaleError, changed
from tools.measure.card import ROOT, SCENARIOS, Flight, Line, commit_of, flown, read_lines, seeds_of

LIST = Path(__file__).with_suffix(".yaml")
FIGURES: dict[Figure, str] = {
    "min_distance_after_10s_m": "nearest", "order_tail": "order", "recall_within_10m": "recall",
    "false_share": "false", "associated_error_median_m": "median", "associated_error_p95_m": "p95",
    "associated_error_max_m": "max", "slowed_share": "slowed",
}  # fmt: skip
"""What is compared, and its column."""
MEANS_NOTHING = {("head-on", "order_tail")}
"""Figures without a meaning: head-on, drones fly in opposite directions."""

Mechanism = Mapping[str, Any]
"""`name`, `lines`, `changes` (`in`, `old`, `new`) and perhaps `note`, as in the list."""
AS_IT_IS: Mechanism = {"name": "as it is", "lines": 0, "changes": []}
Plan = tuple[str, int, float | None]
"""A flight's scenario, seed and seconds, None: the file's."""


def listed(only: str = "") -> list[Mechanism]:
    """Mechanisms whose name contains the word, the largest first. Raises StaleError if one does not fit the sources."""
    found = [one for one in yaml.safe_load(LIST.read_text(encoding="utf-8")) if only in one["name"]]
    for one in found:
        _changed(one, ROOT)
    return sorted(found, key=lambda one: -int(one["lines"]))


def _changed(mechanism: Mechanism, root: Path) -> dict[Path, str]:
    """By file, its source with the mechanism left out. Raises StaleError."""
    sources: dict[Path, str] = {}
    for change in mechanism["changes"]:
        try:
            file, source = changed(change["in"], change["old"], change["new"], root)
        except StaleError as error:
            raise StaleError(f"{mechanism['name']}: {error}") from error
        sources[file] = sources[file].replace(change["old"], change["new"]) if file in sources else source
    return sources


def copy_without(mechanism: Mechanism, folder: Path) -> None:
    """The package and its tools in an empty folder, with the mechanism left out."""
    for name in ("flockd", "tools"):
        shutil.copytree(ROOT / name, folder / name)
    for name in ("models", "config", "pyproject.toml"):
        (folder / name).symlink_to(ROOT / name)
    for file, source in _changed(mechanism, ROOT).items():
        (folder / file).write_text(source, encoding="utf-8")


def key_of(mechanism: Mechanism) -> str:
    """Identifies its flights, and the way in which it was left out."""
    return f"{mechanism['name']} {hashlib.sha256(repr(mechanism['changes']).encode()).hexdigest()[:8]}"


def run(mechanism: Mechanism, plans: Sequence[Plan], commit: str, results: Path) -> None:
    """Fly what ``results`` does not have yet; each flight is a line there as soon as it has ended."""
    who = {"commit": commit, "mechanism": key_of(mechanism)}
    done = [line["plan"] for line in read_lines(results) if line["failed"] is None and who.items() <= line.items()]
    missing = [plan for plan in plans if list(plan) not in done]
    if not missing:
        return
    with tempfile.TemporaryDirectory(prefix="flockd-without-") as name:
        copy_without(mechanism, Path(name))
        command = [sys.executable, "-c", "from tools.measure.ablate import fly_here; fly_here()", json.dumps(missing)]
        environment = {**os.environ, "PYTHONPATH": name}
        with subprocess.Popen(command, cwd=name, env=environment, stdout=subprocess.PIPE, text=True) as child:
            for text in child.stdout or ():
                if not text.startswith("{"):  # of a library
                    continue
                line = who | json.loads(text)
                with results.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
                said = line["failed"] or f"{line['wall_s']:.0f} s"
                print(f"{mechanism['name']}: {line['scenario']}, seed {line['seed']}: {said}", file=sys.stderr)


def fly_here() -> None:
    """In a copy: fly the plans of the command line, and print a line for each."""
    if not Path(flockd.__file__).is_relative_to(Path.cwd()):
        raise SystemExit(f"{flockd.__file__} was imported, not the copy in {Path.cwd()}")
    for scenario, seed, seconds in json.loads(sys.argv[1]):
        of = SCENARIOS[scenario]
        line = flown(Flight(scenario, "sight", seed, of.file, seconds, of.overrides(seed, turn=0)))
        print(json.dumps({**line, "plan": [scenario, seed, seconds]}), flush=True)


def compared(scenario: str, as_it_is: Iterable[Line], left_out: Iterable[Line]) -> dict[str, Any]:
    """Of flights of one scenario, by seed: how many pairs, whether all are the same, and by figure the mean difference,
    half of its interval, and whether that shows a "gain" or a "loss"."""
    before = {line["seed"]: line["figures"] for line in as_it_is}
    pairs = [(before[line["seed"]], line["figures"]) for line in left_out if line["seed"] in before]
    figures = {}
    for figure in FIGURES:
        known = [(a[figure], b[figure]) for a, b in pairs if a.get(figure) is not None and b.get(figure) is not None]
        interval = mean_interval([b - a for a, b in known])
        if interval is not None and (scenario, figure) not in MEANS_NOTHING:
            better = (interval.mean > 0.0) == (MEASURES[figure].better == "higher")
            shown = abs(interval.mean) > interval.half_width
            shows = "" if not shown else "gain" if better else "loss"
            figures[figure] = {"mean": interval.mean, "half": interval.half_width, "shows": shows}
    return {"pairs": len(pairs), "same": bool(pairs) and all(a == b for a, b in pairs), "figures": figures}


def row_of(mechanism: Mechanism, lines: Iterable[Line]) -> dict[str, Any]:
    """The verdict and figures of one mechanism, from the flights of all."""
    by: dict[str, dict[str, list[Line]]] = {}
    for line in lines:
        by.setdefault(line["scenario"], {}).setdefault(line["mechanism"], []).append(line)
    scenarios = {
        name: compared(name, of.get(key_of(AS_IT_IS), ()), of.get(key_of(mechanism), ())) for name, of in by.items()
    }
    flown_in = {name: one for name, one in scenarios.items() if one["pairs"]}
    found: dict[str, list[str]] = {"loss": [], "gain": [], "": []}
    for name, one in flown_in.items():
        for figure, of in one["figures"].items():
            found[of["shows"]].append(f"{FIGURES[figure]} ({name})")
    shown = [f"{what}: {', '.join(found[what])}" for what in ("loss", "gain") if found[what]]
    same = "does nothing" if all(one["same"] for one in flown_in.values()) else "no loss shown"
    return {**mechanism, "verdict": "; ".join(shown) or same if flown_in else "not flown", "scenarios": flown_in}


def show(rows: Iterable[Mapping[str, Any]]) -> None:
    """Print them: `!` marks a loss, `+` a gain."""
    print(f"{'':18}pairs" + "".join(f"{column:>16}" for column in FIGURES.values()))
    for row in rows:
        print(f"{row['name']} ({row['lines']} lines): {row['verdict']}" + (f"; {row['note']}" if "note" in row else ""))
        for name, one in row["scenarios"].items():
            cells = [one["figures"].get(figure) for figure in FIGURES]
            marks = {"loss": "!", "gain": "+", "": " "}
            words = [f"{c['mean']:+.3f}±{c['half']:.3f}{marks[c['shows']]}" if c else "" for c in cells]
            print(f"  {name[:16]:16}{one['pairs']:5}" + "".join(f"{word:>16}" for word in words))


def main() -> int:
    """Fly what is missing, and print the table; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="WORD", default="", help="mechanisms whose name contains it")
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, default=list(SCENARIOS), metavar="NAME")
    parser.add_argument("--seeds", type=int, default=10, help="flights of each scenario")
    parser.add_argument("--seconds", type=float, help="of each flight, but of those of their file's length (head-on)")
    parser.add_argument("--results", type=Path, default=ROOT / "out" / "ablate.jsonl", help="default: out/ablate.jsonl")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="mechanisms flown at once")
    arguments = parser.parse_args()
    try:
        mechanisms = listed(arguments.only)
    except StaleError as error:
        print(f"{LIST.name}: {error}", file=sys.stderr)
        return 1
    commit, results, plans = commit_of(ROOT), arguments.results, list[Plan]()
    for name in arguments.scenarios:
        usual = SCENARIOS[name].quick[1]
        seconds = usual and (arguments.seconds or usual)
        plans += [(name, seed, seconds) for seed in seeds_of(commit, name, arguments.seeds)]
    results.parent.mkdir(parents=True, exist_ok=True)
    whole = "".join(json.dumps(line) + "\n" for line in read_lines(results))
    results.write_text(whole, encoding="utf-8")  # without a line that was cut short
    with ThreadPoolExecutor(arguments.workers) as pool:
        fly = partial(run, plans=plans, commit=commit, results=results)
        list(pool.map(fly, [AS_IT_IS, *mechanisms]))
    lines = [one for one in read_lines(results) if one["commit"] == commit and one["failed"] is None]
    rows = [row_of(one, [line for line in lines if tuple(line["plan"]) in plans]) for one in mechanisms]
    show(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())

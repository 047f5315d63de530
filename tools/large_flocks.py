"""How large a flock can get: flies flocks of 5 to 1,000 drones at control level, and prints and draws what came of it.

    python -m tools.large_flocks out/large_flocks.jsonl                          # flies what is missing there
    python -m tools.large_flocks out/large_flocks.jsonl --table                  # the figures, in Markdown
    python -m tools.large_flocks out/large_flocks.jsonl --pictures docs/pictures
    python -m tools.large_flocks out/large_flocks.jsonl --sampling               # what a shorter step changes

The paper's flight, a circle and its tangent, by drones that start on a grid of 3.5 m, all at one height; each start is
moved by up to 0.5 m by the seed. Perception is exact or as config/perceived/shipped_networks.yaml says. Every flight is
a line of the file as soon as its cell is flown; all take about five minutes of processor time.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flockd.config import ScenarioConfig, load_scenario
from flockd.config.loader import load_perceived_errors
from flockd.control_level import fly_flocks, scattered
from flockd.control_level.flock_flights import FlockFlights
from flockd.data import data_path
from flockd.report.style import INK, MUTED, STYLE, colour_of
from flockd.sim.start import with_drones

SEEDS = {5: 8, 10: 8, 15: 8, 20: 8, 25: 8, 50: 8, 100: 6, 250: 4, 500: 3, 1000: 2}
LABELLED = (5, 10, 25, 50, 100, 250, 500, 1000)
"""Flights of each size."""
WEIGHTS: dict[str, dict[str, Any]] = {
    "uniform": {"kind": "uniform"},
    "nearest 12": {"kind": "nearest", "nearest": 12},
    "nearest 6": {"kind": "nearest", "nearest": 6},
    "nearest 3": {"kind": "nearest", "nearest": 3},
}
PERCEPTIONS = ("exact", "measured")
HEIGHT_M, SPREAD_M = 4.5, 0.5
SHOWN = {
    "min_level_distance_m": ("nearest distance, m", (0.0, 3.5)),
    "mean_nearest_tail_m": ("mean distance to the nearest, last 10 s, m", (0.0, 4.0)),
    "order_tail": ("order, last 10 s", (-0.05, 1.05)),
}
SNAPSHOT_DRONES, SNAPSHOT_S = 250, 60.0
ERRORS = data_path("config") / "perceived" / "shipped_networks.yaml"


class Cell(NamedTuple):
    """What is flown several times."""

    perception: str
    weight: str
    drones: int


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("results", type=Path)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--sampling", action="store_true")
    parser.add_argument("--pictures", type=Path, metavar="DIR")
    parser.add_argument("--perception", choices=PERCEPTIONS, help="of this only")
    parser.add_argument("--most", type=int, default=max(SEEDS.values()), help="flights of a cell")
    args = parser.parse_args()
    if args.table:
        print(table(read(args.results)))
    elif args.sampling:
        print_sampling()
    elif args.pictures:
        draw(read(args.results), args.pictures / "large_flocks.webp")
        draw_snapshots(args.pictures / "large_flocks_seen.webp")
    else:
        fly_missing(args.results, [args.perception] if args.perception else PERCEPTIONS, args.most)


def cells(perceptions: Sequence[str]) -> Iterator[Cell]:
    """From small to large."""
    for drones in SEEDS:
        for perception in perceptions:
            for weight in WEIGHTS:
                yield Cell(perception, weight, drones)


def scenario_of(cell: Cell, seed: int, **overrides: Any) -> ScenarioConfig:
    """One flight."""
    keys = {f"drone.flocking.weight.{key}": value for key, value in WEIGHTS[cell.weight].items()}
    scenario = load_scenario(data_path("config") / "large_flock.yaml", {"seed": seed, **keys, **overrides})
    return scattered(with_drones(scenario, cell.drones), SPREAD_M, HEIGHT_M)


def fly_missing(path: Path, perceptions: Sequence[str], most: int) -> None:
    """Flies what is not in the file, a cell at a time, and adds it."""
    known = {(Cell(row["perception"], row["weight"], row["drones"]), row["seed"]) for row in read(path)}
    errors = load_perceived_errors(ERRORS)
    path.parent.mkdir(parents=True, exist_ok=True)
    for cell in cells(perceptions):
        seeds = [seed for seed in range(min(SEEDS[cell.drones], most)) if (cell, seed) not in known]
        if not seeds:
            continue
        scenarios = [scenario_of(cell, seed) for seed in seeds]
        found = fly_flocks(scenarios, errors=errors if cell.perception == "measured" else None)
        with path.open("a", encoding="utf-8") as file:
            for seed, figures in zip(seeds, found, strict=True):
                file.write(json.dumps({**cell._asdict(), "seed": seed, **figures}) + "\n")
        print(*cell, len(seeds), flush=True)


def read(path: Path) -> list[dict[str, Any]]:
    """The flights flown so far."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def table(rows: Sequence[dict[str, Any]]) -> str:
    """For each perception, sizes by weights: nearest distance (least of all flights), order, and contacts a drone."""
    lines = []
    for perception in PERCEPTIONS:
        lines += [
            f"\n{perception} perception:\n",
            f"| drones | {' | '.join(WEIGHTS)} |",
            "|---" * (len(WEIGHTS) + 1) + "|",
        ]
        for drones in SEEDS:
            found = [_summary(rows, Cell(perception, weight, drones)) for weight in WEIGHTS]
            lines.append(f"| {drones} | {' | '.join(found)} |")
    union = min((row["union_tail"] for row in rows), default=1.0)
    return "\n".join([*lines, f"\n{len(rows)} flights; least union {union:.3f}"])


def _summary(rows: Sequence[dict[str, Any]], cell: Cell) -> str:
    """Of a cell's flights."""
    of = [row for row in rows if (row["perception"], row["weight"], row["drones"]) == cell]
    if not of:
        return "-"
    least, order = min(row["min_level_distance_m"] for row in of), statistics.fmean(row["order_tail"] for row in of)
    contacts = statistics.fmean(row["drone_collisions"] for row in of) / cell.drones
    return f"{least:.2f} m, {order:.3f}, {contacts:.1f}"


def print_sampling() -> None:
    """With weight on all, exact states, two flights of a minute: the paper's step and one a fifth as long."""
    for step_s in (0.5, 0.1):
        for drones in (25, 50):
            cell, keys = Cell("exact", "uniform", drones), {"drone.step_s": step_s, "duration_s": 60.0}
            found = fly_flocks([scenario_of(cell, seed, **keys) for seed in range(2)])
            means = [statistics.fmean(float(one[key] or 0.0) for one in found) for key in list(SHOWN)[1:]]
            print(f"step {step_s} s, {drones} drones: {means[0]:.2f} m to the nearest, order {means[1]:.2f}")


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Each figure over the size of the flock, exact and measured."""
    with rc_context(STYLE):
        figure = Figure(figsize=(9.0, 7.2), layout="constrained")
        grid = figure.subplots(len(SHOWN), len(PERCEPTIONS), sharex=True, sharey="row")
        for axes_of_figure, (key, (name, limits)) in zip(grid, SHOWN.items(), strict=True):
            for axes, perception in zip(axes_of_figure, PERCEPTIONS, strict=True):
                _draw_lines(axes, [row for row in rows if row["perception"] == perception], key)
                axes.set(ylim=limits)
                axes.set_title(f"{name}, {perception}", fontsize=9)
        for axes in grid[-1]:
            axes.set(xlabel="drones", xscale="log", xticks=LABELLED, xticklabels=[str(n) for n in LABELLED])
            axes.minorticks_off()
        grid[0][0].legend(fontsize=8, ncols=2)
        _save(figure, path)


def _draw_lines(axes: Axes, rows: Sequence[dict[str, Any]], key: str) -> None:
    """The mean of each weight over the size, and from the least to the greatest of its flights."""
    for number, weight in enumerate(WEIGHTS):
        values = {n: [r[key] for r in rows if r["weight"] == weight and r["drones"] == n] for n in SEEDS}
        values = {n: of for n, of in values.items() if of}
        sizes, colour = list(values), colour_of(number, len(WEIGHTS))
        axes.plot(
            sizes, [statistics.fmean(of) for of in values.values()], "o-", color=colour, markersize=3, label=weight
        )
        least, greatest = [min(of) for of in values.values()], [max(of) for of in values.values()]
        axes.fill_between(sizes, least, greatest, color=colour, alpha=0.18, linewidth=0)


def draw_snapshots(path: Path) -> None:
    """Where the drones of one flight are after a minute, with each weight, by exact states."""
    with rc_context(STYLE):
        figure = Figure(figsize=(9.0, 2.7), layout="constrained")
        for axes, (number, weight) in zip(figure.subplots(1, len(WEIGHTS)), enumerate(WEIGHTS), strict=True):
            flights = FlockFlights([scenario_of(Cell("exact", weight, SNAPSHOT_DRONES), 0, duration_s=SNAPSHOT_S)])
            for step in range(flights.steps):
                flights.step(step, None, 1)
            north, east = flights.states[:2, 0] - flights.states[:2, 0].mean(axis=1, keepdims=True)
            axes.plot(east, north, ".", color=colour_of(number, len(WEIGHTS)), markersize=2.5)
            axes.set(aspect="equal", xlim=(-42, 42), ylim=(-42, 42), xticks=(-40, 0, 40), yticks=(-40, 0, 40))
            axes.set_title(weight, fontsize=9, color=INK)
            axes.tick_params(colors=MUTED, labelsize=7)
        _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=110, pil_kwargs={"quality": 82})
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

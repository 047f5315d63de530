"""Writes the tables of figures in README and docs from docs/figures.json, which `tools.measure.card` measures.

python -m tools.docs.figures    # writes the pages

A page has a table between `<!-- figures: NAME -->` and `<!-- end of figures -->`, NAME being one of `TABLES`.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flockd.campaign.figures import MEASURES, Figure
from tools.measure.card import EYES, FIGURES, FIGURES_FILE, ROOT, git
from tools.measure.labelled import WIDTH_CLASSES

BLOCK = re.compile(r"(<!-- figures: (\w+) -->\n).*?(<!-- end of figures -->)", re.DOTALL)
AGE = re.compile(r" \d+ commits? of `flockd/flight` since\.")
"""The age in commits, which is that of the time when the page was written."""
Part = Mapping[str, Any]
PAPERS = "the paper's five drones"
SHORT = ("order_tail", "recall_within_10m", "false_share", "associated_error_median_m", "min_distance_after_10s_m",
         "slowed_share")  # fmt: skip
"""Of README."""
EACH = ("order_tail", "convergence_time_s", "shape_deviation_tail", "recall_within_10m", "false_share",
        "associated_error_median_m", "associated_error_max_m", "min_distance_after_10s_m")  # fmt: skip
STAGES = {
    "scene": "checks of the images; the first network's maps and depth, of every camera",
    "flow": "optical flow of every camera",
    "detection": "crops, second stage, suppression, masks",
    "ego_motion": "the own motion, its scale by the ground, whether each camera agrees with the autopilot",
}
WORST = 5
ENOUGH_FOR_AN_INTERVAL = 10


def pages() -> list[Path]:
    """The pages that may have tables."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def written(text: str, parts: Mapping[str, Part]) -> str:
    """A page's text with its tables."""
    return BLOCK.sub(lambda found: f"{found[1]}{TABLES[found[2]](parts)}\n{found[3]}", text)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def _origin(part: Part) -> str:
    """By which command, of which commit, and how old that is."""
    commit = part["commit"]
    try:
        count = int(git(ROOT, "rev-list", "--count", f"{commit}..HEAD", "--", "flockd/flight"))
    except (OSError, subprocess.CalledProcessError):
        count = 0
    since = f"{count} commit{'s' * (count != 1)} of `flockd/flight` since."
    return f"\n`{part['command']}`, commit {commit[:8]}, {part['date']}, {part['machine']}; {since}"


def _cell(of: Part, figure: str) -> str:
    """A figure's median over the flights that have it, and their number if some have not."""
    one = of["figures"].get(figure)
    if one is None:
        return "-"
    if one["count"] < (flown := of["flights"] - of["failed"]):
        return f"{one['median']:g} in {one['count']} of {flown}"
    between = "" if one["count"] < ENOUGH_FOR_AN_INTERVAL else " [{:g}, {:g}]".format(*one["interval"])
    return f"{one['median']:g}{between}" + (f" ({one['worst']:g})" if one["count"] > 1 else "")


def _named(figure: str) -> str:
    return f"{MEASURES[figure].name}{', ' * bool(MEASURES[figure].unit)}{MEASURES[figure].unit}"


def _readme(parts: Mapping[str, Part]) -> str:
    """Of the paper's flights: median and, in brackets, worst, by sight, blind and exact."""
    of = parts["flights"][PAPERS]
    rows = [[_named(figure), *(_cell(of[eyes], figure) for eyes in EYES)] for figure in SHORT]
    return _table((f"{_flown(PAPERS, of)}, median (worst)", "by sight", "blind", "exact"), rows) + "\n" + _origin(of)


def _flights(parts: Mapping[str, Part]) -> str:
    """Of every scenario: what each kind of flock reached, then what drones by sight knew of each other."""
    flights = parts["flights"]

    def known_to(*eyes: str) -> list[Figure]:
        return [name for name in FIGURES if any(name in of[one]["figures"] for of in flights.values() for one in eyes)]

    reached = known_to("blind", "exact")
    seen = [name for name in known_to("sight") if name not in reached]
    of_one = {
        name: having[0]
        for name in reached
        if len(having := [one for one, of in flights.items() if name in of["exact"]["figures"]]) == 1 < len(flights)
    }
    columns = [name for name in reached if name not in of_one]
    rows = [
        [_flown(scenario, of) if eyes == "sight" else "", eyes, *(_cell(of[eyes], name) for name in columns)]
        for scenario, of in flights.items()
        for eyes in EYES
    ]
    by_sight = [[scenario, *(_cell(of["sight"], name) for name in seen)] for scenario, of in flights.items()]
    apart = [
        f"{_named(name)} ({scenario}): {', '.join(f'{eyes} {_cell(flights[scenario][eyes], name)}' for eyes in EYES)}."
        for name, scenario in of_one.items()
    ]
    origins: dict[str, list[str]] = {}
    for scenario, of in flights.items():
        origins.setdefault(_origin(of).strip(), []).append(scenario)
    return "\n\n".join((
        _table(("flights", "known by", *map(_named, columns)), rows),
        *apart,
        _table(("by sight", *map(_named, seen)), by_sight),
        *(f"Flown for {'; '.join(scenarios)}: {origin}" for origin, scenarios in origins.items()),
    ))  # fmt: skip


def _flown(scenario: str, of: Part) -> str:
    """How often it was flown, and for how long."""
    count = of["sight"]["flights"] - of["sight"]["failed"]
    return f"{scenario}: {count} flight{'s' * (count != 1)} of {of['duration_s']:g} s"


def _each(parts: Mapping[str, Part]) -> str:
    """The paper's flights by sight with the largest shape deviation, and the one with the lowest order."""
    of = parts["flights"][PAPERS]
    worst = sorted(of["sight"]["each"], key=lambda one: -one.get("shape_deviation_tail", math.inf))
    rows = [[f"{one[figure]:g}" if figure in one else "-" for figure in ("seed", *EACH)] for one in worst[:WORST]]
    low = min(of["sight"]["each"], key=lambda one: one["order_tail"])
    told = (
        f"Lowest order: seed {low['seed']}, {low['order_tail']:g}. From 10 s on no two of its drones came nearer than "
        f"{low['min_distance_after_10s_m']:g} m; gates slowed them in {low['slowed_share']:g} of the time."
    )
    return _table(("seed", *map(_named, EACH)), rows) + f"\n\n{told}\n{_origin(of)}"


def _paper(parts: Mapping[str, Part]) -> str:
    """What the paper says of the same flight: its largest errors, and its Table 3."""
    of = parts["flights"][PAPERS]
    rows = [
        ("distance to a neighbour, largest error, m", "0.168", _cell(of["sight"], "associated_error_max_m")),
        ("time from which the shape stays, s", "67", _cell(of["sight"], "convergence_time_s")),
    ]
    return _table(("", "paper, one flight", "flockd, median (worst)"), rows) + "\n" + _origin(of)


def _encounters(parts: Mapping[str, Part]) -> str:
    rows = [
        (f"{one['speed_m_s']:g} m/s", one["airframe"], str(one["flights"]), f"{one['nearest_m']:g} m",
         str(one["touched"]))
        for one in parts["encounters"]["found"]
    ]  # fmt: skip
    head = "each flies", "airframe", "flights", "nearest", "touched"
    return _table(head, rows) + "\n" + _origin(parts["encounters"])


def _pictures(parts: Mapping[str, Part]) -> str:
    rows = []
    for name, one in parts["pictures"]["found"].items():
        widths = (one["by_width"][width] for width in WIDTH_CLASSES)
        shares = [f"{of['found'] / of['boxes']:.0%} of {of['boxes']}" if of["boxes"] else "" for of in widths]
        precision = "" if one["ap50"] is None else f"{one['ap50']:.2f}"
        rows.append([name, str(one["images"]), *shares, precision, f"{one['false']} in {one['measured']}"])
    head = ("set", "pictures", *(f"{width} px found" for width in WIDTH_CLASSES), "average precision", "false")
    return _table(head, rows) + "\n" + _origin(parts["pictures"])


def _px4(parts: Mapping[str, Part]) -> str:
    rows = [
        (one["flight"], f"{one['speed_factor']:g}", f"{one['off_m_s']:.3f}", f"{one['truly_off_m_s']:.3f}",
         f"{one['order']:.3f}", "-" if one["closest_m"] is None else f"{one['closest_m']:.2f}",
         f"{one['longest_step_s']:.2f}", "kept" if one["kept"] else "not kept", one["modes"])
        for one in parts["px4"]["found"]
    ]  # fmt: skip
    head = ("flight", "time factor", "deviation, m/s", "true deviation, m/s", "order", "nearest, m", "longest step, s",
            "limit of the deviation", "modes")  # fmt: skip
    return _table(head, rows) + "\n" + _origin(parts["px4"])


def _px4_stories(parts: Mapping[str, Part]) -> str:
    """The stories by outcome, each with its cases in brackets."""
    told: dict[str, dict[str, list[str]]] = {}
    for story, end in parts["px4_stories"]["found"].items():
        name, _, case = story.replace("px4 1 18", "PX4 1.18").replace("px4", "PX4").rstrip("]").partition("[")
        told.setdefault(end, {}).setdefault(name, []).append(case)
    rows = []
    for end, stories in told.items():
        names = [f"{name} ({', '.join(cases)})" if any(cases) else name for name, cases in stories.items()]
        rows.append((f"{sum(map(len, stories.values()))} {end}", "; ".join(names)))
    return _table(("with PX4", "stories"), rows) + "\n" + _origin(parts["px4_stories"])


def _step(parts: Mapping[str, Part]) -> str:
    stages = parts["step"]["found"]["profile"]["stages"]
    rows = [
        (f"`{name}`", f"{one['p50_ms']:.1f}", f"{one['p95_ms']:.1f}", STAGES.get(name, ""))
        for name, one in stages.items()
    ]
    return _table(("stage", "p50, ms", "p95, ms", "what it does"), rows) + "\n" + _origin(parts["step"])


TABLES: dict[str, Callable[[Mapping[str, Part]], str]] = {
    "flights": _flights,
    "each": _each,
    "readme": _readme,
    "paper": _paper,
    "encounters": _encounters,
    "pictures": _pictures,
    "px4": _px4,
    "px4_stories": _px4_stories,
    "step": _step,
}


def main() -> None:
    """Writes the pages."""
    parts = json.loads(FIGURES_FILE.read_text(encoding="utf-8"))
    for page in pages():
        page.write_text(written(page.read_text(encoding="utf-8"), parts), encoding="utf-8")


if __name__ == "__main__":
    main()

"""Figures of performance on the pages are those of docs/figures.json, measured with the networks that are shipped."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from flockd.core.data import data_path
from flockd.flight.inference.manifest_file import model_hashes
from flockd.sim.scenario import load_scenario
from tools.docs.figures import AGE, BLOCK, TABLES, pages, written
from tools.measure.card import FIGURES_FILE, ROOT

BY_HAND = re.compile(r"\b\d{1,2} (?:October|November|December) 20\d\d\b|\bcommit [0-9a-f]{7,40}\b")
"""What a figure that somebody measured and typed says with it."""
PARTS = json.loads(FIGURES_FILE.read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_tables_are_generated_and_no_figure_is_typed(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert AGE.sub("", text) == AGE.sub("", written(text, PARTS)), "run python -m tools.docs.figures"
    assert BY_HAND.findall(BLOCK.sub("", text)) == []


def test_every_table_is_on_a_page() -> None:
    found = {name for page in pages() for _, name, _ in BLOCK.findall(page.read_text(encoding="utf-8"))}
    assert found == set(TABLES)


def test_flights_were_flown_with_the_networks_that_are_shipped() -> None:
    for flown in PARTS["flights"].values():
        shipped = model_hashes(load_scenario(data_path("config") / flown["file"]).drone.perception)
        assert flown["networks"] == shipped


def test_a_table_says_median_and_worst_beside_the_exact_and_the_blind() -> None:
    def eyes(median: float) -> dict[str, Any]:
        order = {"median": median, "worst": median - 0.1, "interval": [0, 1], "count": 3}
        return {"flights": 3, "failed": 0, "figures": {"order_tail": order}}

    part: dict[str, Any] = {
        "commit": "0" * 40, "date": "2026-11-28", "command": "python -m nothing", "machine": "none",
        "duration_s": 30.0, "sight": eyes(0.9), "blind": eyes(0.5), "exact": eyes(0.99),
    }  # fmt: skip
    part["sight"]["figures"]["convergence_time_s"] = {"median": 70.0, "worst": 70.0, "interval": [70, 70], "count": 1}
    page = written("<!-- figures: flights -->\nold\n<!-- end of figures -->", {"flights": {"square": part}})
    assert "old" not in page
    head, _, *rows = page.splitlines()[1:6]
    assert head == "| flights | known by | order at the end |"
    assert rows[0] == "| square: 3 flights of 30 s | sight | 0.9 (0.8) |"
    assert rows[1:] == ["|  | blind | 0.5 (0.4) |", "|  | exact | 0.99 (0.89) |"]
    assert "| by sight | time from which the shape stays, s |\n| --- | --- |\n| square | 70 in 1 of 3 |" in page


def test_of_each_flight_the_one_with_the_lowest_order_is_told() -> None:
    each = [
        {"seed": seed, "order_tail": order, "shape_deviation_tail": shape, "min_distance_after_10s_m": 1.5,
         "slowed_share": 0.2}
        for seed, order, shape in ((3, 0.99, 40.0), (7, 0.5, 20.0))
    ]  # fmt: skip
    origin = {"commit": "0" * 40, "date": "2026-11-28", "command": "python -m nothing", "machine": "none"}
    part = {"the paper's five drones": {**origin, "sight": {"each": each}}}
    page = written("<!-- figures: each -->\n<!-- end of figures -->", {"flights": part})
    assert page.splitlines()[3].startswith("| 3 |"), "the largest shape deviation first"
    assert "Lowest order: seed 7, 0.5. From 10 s on no two of its drones came nearer than 1.5 m; gates" in page

"""Flights are kept as they are finished, whatever flies them, and nothing is lost or flown twice."""

from __future__ import annotations

import csv
import fcntl
import os
import re
from itertools import pairwise
from pathlib import Path

import pytest

from flockd.campaign.campaign_page import parameter_curves, write_campaign_page
from flockd.campaign.flight_plan import Plan
from flockd.campaign.folder import LINES_NAME, CampaignFolder
from flockd.campaign.results import Results, compare
from flockd.cli import main
from flockd.core.errors import UnavailableError, UsageError
from tests.campaign.flights import HEAD, Shuffled, campaign_file, flown, made_up

pytestmark = pytest.mark.usefixtures("made_up_flights")
GRID = "vary: {drone.flocking.cohesion: {values: [0.1, 0.2]}}\nmeasure: [min_distance_m, order_tail]\n"


@pytest.fixture
def made_up_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flockd.campaign.flight_kinds.figures_flown", made_up)


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    return Plan.load(campaign_file(tmp_path, GRID))


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "flights.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_the_same_results_in_any_order_and_after_any_interruption(plan: Plan, tmp_path: Path) -> None:
    """12 flights; one folder is interrupted twice, and has a second line of each flight, which does not count."""
    assert flown(plan, tmp_path / "a", Shuffled(1)).flown == 12
    for until in (2, 4):
        with pytest.raises(KeyboardInterrupt):
            flown(plan, tmp_path / "b", Shuffled(until, until=until))
    last = flown(plan, tmp_path / "b", Shuffled(3, room=1))
    assert (last.flown, last.failed, last.before) == (6, 1, 6)
    lines = tmp_path / "b" / LINES_NAME
    lines.write_bytes(lines.read_bytes() + lines.read_bytes().replace(b'"reason":null', b'"reason":"again"'))
    assert flown(plan, tmp_path / "b", Shuffled(4)).before == 12
    a, b = ((tmp_path / name / "flights.csv").read_bytes() for name in "ab")
    assert a == b


def test_a_report_takes_no_other_files_place(plan: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown(plan, tmp_path / "out", Shuffled(1))
    notes = tmp_path / "notes.html"
    notes.write_text("mine", encoding="utf-8")
    assert main(["campaign", "report", str(tmp_path / "out"), "--out", str(notes)]) == 2
    assert capsys.readouterr().err == f"{notes}: exists; name another file\n"
    assert notes.read_text(encoding="utf-8") == "mine"


def test_a_kill_leaves_what_was_finished(plan: Plan, tmp_path: Path) -> None:
    """Three flights of which the last is cut off as it is written, and before the tables are."""
    path = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        flown(plan, path, Shuffled(1, until=3))
    lines = (path / LINES_NAME).read_bytes()
    (path / "flights.csv").unlink()
    (path / LINES_NAME).write_bytes(lines[:-9])
    (path / ".flights.csv.part").write_bytes(b"half")
    conducted = flown(plan, path, Shuffled(9))
    assert (conducted.before, conducted.flown) == (2, 10)
    assert [(int(row["cell"]), int(row["number"])) for row in table(path)] == [
        (cell, seed) for cell in (0, 1) for seed in range(6)
    ]


def test_a_flight_that_fails_is_a_row_with_its_reason(plan: Plan, tmp_path: Path) -> None:
    conducted = flown(plan, tmp_path / "out", Shuffled(1))
    assert conducted.failed == 2
    rows = table(tmp_path / "out")
    failed = [row for row in rows if row["status"] == "failed"]
    assert [row["run"] for row in failed] == ["c0-s3", "c1-s3"]
    assert all(row["reason"].startswith("ArithmeticError: no flight today (flights.py:") for row in failed)
    assert all(row["min_distance_m"] == "" for row in failed)
    assert {row["drone.flocking.cohesion"] for row in rows} == {"0.1", "0.2"}


def test_another_campaign_is_refused(plan: Plan, tmp_path: Path) -> None:
    flown(plan, tmp_path / "out", Shuffled(1))
    changed = Plan.load(campaign_file(tmp_path, GRID.replace("0.2]", "0.3]")))
    with pytest.raises(
        UsageError, match=r"`campaign\.vary\.drone\.flocking\.cohesion\.values` was \[0\.1, 0\.2\] and is"
    ):
        flown(changed, tmp_path / "out", Shuffled(1))
    orders = "b: {duration_s: 9.0}, a: {}", "a: {}, b: {duration_s: 9.0}"
    cases = [Plan.load(campaign_file(tmp_path, GRID + f"cases: {{{order}}}\n")) for order in orders]
    flown(cases[0], tmp_path / "cases", Shuffled(1))
    with pytest.raises(UsageError, match="entries of `cases` in another order"):
        flown(cases[1], tmp_path / "cases", Shuffled(1))
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.txt").write_text("the only copy")
    with pytest.raises(UsageError, match="holds other files than a campaign's"):
        flown(plan, tmp_path / "thesis", Shuffled(1))
    with (tmp_path / "out" / ".lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="another process is flying this campaign"):
            flown(plan, tmp_path / "out", Shuffled(1))


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"{garbled", "Expecting property name"),
        (b"[" * 100_000, "it is nested too deep"),
        (b'{"campaign": ' + b"[" * 200 + b"]" * 200 + b"}", "campaign: "),
        (b"\xff{}", "can't decode byte"),
        (b"[]", "it holds something else"),
        (b"{}", "it has no 'campaign'"),
        (b'{"campaign": {"campaign": "x"}, "scenario": {}}', "scenario: Field required"),
        (None, "it is not an ordinary file"),
    ],
)
def test_a_plan_that_is_none_is_one_sentence(
    content: bytes | None, why: str, plan: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether it is reported, flown again, or gone on with."""
    folder = tmp_path / "out"
    flown(plan, folder, Shuffled(1))
    path = folder / "campaign.json"
    path.unlink()
    if content is None:
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    for command in (["report", str(folder)], ["rerun", str(folder / "c0-s0")]):
        assert main(["campaign", *command]) == 2
        told = capsys.readouterr().err
        assert told.startswith(f"{path}: is not a plan of this flockd (")
        assert why in told
        assert told.count("\n") == 1
    with pytest.raises(UsageError) as refused:
        flown(plan, folder, Shuffled(1))
    assert "\n" not in str(refused.value)


def test_a_plan_with_a_number_that_is_none_is_gone_on_with_or_refused_but_never_a_traceback(
    plan: Plan, tmp_path: Path
) -> None:
    """JSON as Python writes it has NaN, which differs from itself."""
    flown(plan, tmp_path / "out", Shuffled(1))
    path = tmp_path / "out" / "campaign.json"
    path.write_text(path.read_text(encoding="utf-8").replace('"seeds": 6', '"seeds": NaN'), encoding="utf-8")
    with pytest.raises(UsageError, match=r"`campaign\.seeds` was NaN and is 6 now"):
        flown(plan, tmp_path / "out", Shuffled(1))
    nan = Plan(plan.config, {**plan.base, "x": float("nan")})
    with CampaignFolder(tmp_path / "nan", nan):
        pass
    with CampaignFolder(tmp_path / "nan", nan):
        pass


@pytest.mark.parametrize("line", [b"word", b"[]", b'{"run": {"cell": 0}}', b'{"run": {"cell": 9, "number": 0}}', None])
def test_a_line_that_is_no_flight_is_one_sentence(line: bytes | None, plan: Plan, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    flown(plan, folder, Shuffled(1))
    path = folder / LINES_NAME
    if line is None:
        path.unlink()
        os.mkfifo(path)
    else:
        path.write_bytes(line + b"\n" + path.read_bytes())
    with pytest.raises((UnavailableError, UsageError)) as refused:
        flown(plan, folder, Shuffled(1))
    assert str(refused.value).startswith(f"{path}:")
    assert "delete" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_report_says_what_was_flown(plan: Plan, tmp_path: Path) -> None:
    flown(plan, tmp_path / "out", Shuffled(1))
    results = Results.load(tmp_path / "out")
    write_campaign_page(results, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "12 flights of paper_flight in 2 cells" in page
    assert f"flockd campaign rerun {tmp_path / 'out' / 'c1-s3'}" in page
    assert "no flight today" in page
    assert page.count("<svg") == 2, "two figures over a parameter"
    assert "http://" not in page.replace("http://www.w3.org", "")
    mean = results.interval("min_distance_m", [1])
    assert mean is not None
    assert sorted(results.by_seed("min_distance_m", [0, 1])) == [0, 1, 2, 4, 5]


def test_names_of_eight_cases_stand_apart_and_no_interval_of_a_share_ends_below_zero(tmp_path: Path) -> None:
    cases = ", ".join(f"case_{number}_with_a_long_name: {{vehicle.gust_m_s: 0.{number}}}" for number in range(8))
    fixed = "{drone.flocking.cohesion: 0, drone.flocking.separation: 8}"
    text = f"cases: {{{cases}}}\nmeasure: [slowed_share]\nfixed: {fixed}\n"
    flown(Plan.load(campaign_file(tmp_path, text)), tmp_path / "out", Shuffled(1))
    results = Results.load(tmp_path / "out")
    interval = results.interval("slowed_share", [0])
    assert interval is not None
    assert interval.low < 0.0 < interval.mean < 1.0
    drawing = parameter_curves(results, "slowed_share")
    drawing.draw_without_rendering()
    (axes,) = drawing.axes
    assert axes.dataLim.y0 == 0.0
    extents = [label.get_window_extent() for label in axes.get_xticklabels()]
    assert len(extents) == 8
    assert all(left.x1 < right.x0 for left, right in pairwise(extents))


def test_figures_stand_under_the_case_and_the_value_that_were_flown(tmp_path: Path) -> None:
    """Neither cases nor values are in the order of the alphabet."""
    text = (
        "vary: {drone.flocking.separation: {values: [50, 1]}}\nmeasure: [order_tail]\n"
        "cases: {weak: {drone.flocking.cohesion: 1}, strong: {drone.flocking.cohesion: 9}}\n"
    )
    flown(Plan.load(campaign_file(tmp_path, text)), tmp_path / "out", Shuffled(1))
    results = Results.load(tmp_path / "out")
    separation = "drone.flocking.separation"
    assert (results.values_of(separation), results.values_of("case")) == ((50, 1), ("weak", "strong"))

    def mean(value: int, case: str) -> float:
        seeds = results.by_seed("order_tail", results.cells_with({separation: value, "case": case}))
        return sum(seeds.values()) / len(seeds)

    # `made_up`: cohesion + 0.1 separation + what cells have in common
    for value in (50, 1):
        assert mean(value, "strong") - mean(value, "weak") == pytest.approx(8.0)
    assert mean(50, "weak") - mean(1, "weak") == pytest.approx(4.9)


def test_two_campaigns_are_compared_by_pairs(tmp_path: Path) -> None:
    """One of 12 seeds fails; in the other 11 all figures are 0.1 larger: of 2^11 ways to give signs 2 are as far."""
    text = "vary: {drone.flocking.separation: {values: [5, 10]}}\nmeasure: [min_distance_m, collisions]\n"
    head = HEAD.replace("seeds: 6", "seeds: 12")
    for name, more in (("old", ""), ("same", "seed: 0\n"), ("new", "fixed: {drone.flocking.cohesion: 0.2}\n")):
        flown(Plan.load(campaign_file(tmp_path, text + more, head)), tmp_path / name, Shuffled(1))
    old, same, new = (Results.load(tmp_path / name) for name in ("old", "same", "new"))
    equal = compare(old, same)
    assert {verdict.says for verdict in equal.verdicts} == {"no difference shown"}
    assert equal.sentence.startswith("No difference is shown")
    found = compare(old, new)
    assert [verdict.says for verdict in found.verdicts] == ["better", "worse"]
    assert [verdict.pairs for verdict in found.verdicts] == [11, 11]
    assert [verdict.difference.mean for verdict in found.verdicts] == pytest.approx([0.1, 0.1])
    assert [verdict.p for verdict in found.verdicts] == [2 * 2 / 2**11] * 2, "adjusted for two figures"
    assert found.changes == (("drone.flocking.cohesion", "0.1", "0.2"),)
    assert re.search(r"better in nearest distance.*worse in collisions", found.sentence)

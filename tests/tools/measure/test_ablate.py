"""What the ablation says of flights whose figures are made up, and that its list fits the sources."""

from __future__ import annotations

from typing import Any

import pytest
from scipy import stats

from tools.checks.breakages import StaleError
from tools.measure import ablate

ONE: ablate.Mechanism = {
    "name": "one",
    "lines": 9,
    "changes": [{"in": "flockd/flight", "old": "nowhere in it", "new": ""}],
}
ORDER, BEFORE, AFTER = "order_tail", [0.9, 0.8, 0.97, 0.7], [0.7, 0.65, 0.7, 0.55]


def lines(mechanism: ablate.Mechanism, figure: str, values: list[float]) -> list[dict[str, Any]]:
    key = ablate.key_of(mechanism)
    return [{"scenario": "varied", "mechanism": key, "seed": k, "figures": {figure: v}} for k, v in enumerate(values)]


@pytest.mark.parametrize(("figure", "shows"), [(ORDER, "loss"), ("false_share", "gain")])
def test_the_difference_is_a_paired_one_with_students_interval(figure: str, shows: str) -> None:
    row = ablate.row_of(ONE, lines(ablate.AS_IT_IS, figure, BEFORE) + lines(ONE, figure, AFTER)[::-1])
    found = row["scenarios"]["varied"]["figures"][figure]
    expected = stats.ttest_rel(AFTER, BEFORE)
    interval = expected.confidence_interval(0.95)
    assert found["mean"] - found["half"] == pytest.approx(interval.low)
    assert found["mean"] + found["half"] == pytest.approx(interval.high)
    assert expected.pvalue < 0.05
    assert row["verdict"].startswith(shows)


@pytest.mark.parametrize(
    ("after", "verdict"), [(BEFORE, "does nothing"), ([0.7, 0.9, 0.8, 0.9], "no loss shown"), ([], "not flown")]
)
def test_what_shows_nothing_is_told_from_what_does_nothing(after: list[float], verdict: str) -> None:
    assert ablate.row_of(ONE, lines(ablate.AS_IT_IS, ORDER, BEFORE) + lines(ONE, ORDER, after))["verdict"] == verdict


def test_the_list_fits_the_sources_and_one_that_fits_no_more_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len({one["name"] for one in ablate.listed()}) >= 50
    monkeypatch.setattr("yaml.safe_load", lambda _: [ONE])
    with pytest.raises(StaleError, match=r"^one: "):
        ablate.listed()

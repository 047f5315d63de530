"""What flights tell of the errors of perception: of one whose errors are made up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flockd.core.data import data_path
from flockd.core.messages import FloatArray
from flockd.review.flight_log.log import FlightLog
from flockd.sim.scenario import load_scenario
from tools.measure import perceived_errors
from tools.measure.perceived_errors import REAL, Samples, detections_missed, fit, missed_at, samples_of

STEP_S, STEPS = 0.5, 6000


def lasting(random: np.random.Generator, time_s: float) -> Any:
    """(S, 3, 3) of standard deviation 1."""
    keep, found = np.exp(-STEP_S / time_s), random.normal(size=(STEPS, 3, 3))
    for k in range(1, STEPS):
        found[k] = keep * found[k - 1] + np.sqrt(1 - keep**2) * found[k]
    return found


def flight(position: FloatArray, tracked: list[tuple[float, ...]]) -> Samples:
    """Of drones that look north; a third has lost its left camera in the last half."""
    steps, drones = position.shape[:2]
    log = SimpleNamespace(
        time_s=STEP_S * np.arange(steps), position=position, has_truth=True,
        attitude=np.tile(np.eye(3), (steps, drones, 1, 1)), recorded=np.ones((steps, drones), bool),
        tracked=np.array(tracked), metadata=SimpleNamespace(by_sight=True, step_s=STEP_S, scenario="three"),
    )  # fmt: skip
    fault = {"drone": 3, "camera": "left", "begin_s": STEP_S * steps / 2}
    scenario = load_scenario(data_path("config") / "paper_flight.yaml", {"faults": (fault,)})
    return samples_of(cast(FlightLog, log), scenario)


def rows(seen: FloatArray) -> list[tuple[float, ...]]:
    """Of (S, N, N, 3) where drones are seen: what a log has of each confirmed track."""
    return [(*at[:2], 10.0 + at[2], *seen[tuple(at)]) for at in np.argwhere(np.isfinite(seen[..., 0]))]


def test_errors_misses_and_false_neighbours_are_measured_as_they_were_made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three 6 m apart, whose headings are wrong by 2 degrees; ranges err by 5 % for 2 s, bearings by 0.03, a tenth is
    missed for 2 s and less, and one drone has a false neighbour 4 m away in every tenth step, each time another. In a
    second flight, a hundredth as long, ranges err by 30 % and nobody is missed: it counts as much."""
    monkeypatch.setattr(perceived_errors, "detections_missed", lambda shares, lasts_s: shares)
    random = np.random.default_rng(0)
    position = np.zeros((STEPS, 3, 3))
    position[:, 1, 0] = 6.0
    position[:, 2, :2] = 3.0, 3.0 * 3**0.5
    relative = position[:, None] - position[:, :, None]
    turn = np.arctan2(relative[..., 1], relative[..., 0]) + 0.03 * lasting(random, 2.0)
    turn += 0.035 * lasting(random, 2.0)[:, :, :1]
    ahead = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    seen = ahead * np.linalg.norm(relative, axis=-1)[..., None] * np.exp(0.05 * lasting(random, 2.0))[..., None]
    seen[lasting(random, 2.0) < -1.2816] = np.nan
    seen[:, range(3), range(3)] = np.nan
    false: list[tuple[float, ...]] = [(step, 0, 100 + step, 0.0, -4.0, 0.0) for step in range(6, STEPS, 10)]
    unknown = flight(position[:60], rows(1.12 * relative[:60] + np.where(relative[:60].any(-1), 0, np.nan)[..., None]))
    found = fit({"a": flight(position, rows(seen) + false), "b": unknown}, {"a": 3, "b": REAL})
    like = found["detections"]["trained"]
    assert like["range_error"] == pytest.approx(0.05, rel=0.1)
    assert like["bearing_error_rad"] == pytest.approx(0.03, rel=0.1)
    (middle_m, missed), (end_m, same) = like["missed"]
    assert (middle_m, end_m, missed) == (6.0, 7.0, same), "nobody is farther"
    assert missed == pytest.approx(0.1, rel=0.2)
    assert like["error_time_s"] == pytest.approx(2.0, rel=0.2)
    assert 0.3 < like["missed_time_s"] < 2.0, "one who is missed for 2 s is not always missed"
    assert like["false_at_once"] == pytest.approx(0.1 / 3, rel=0.01)
    assert (like["false_time_s"], like["false_m"]) == (0.5, [4.0, 4.0, 4.0])
    (bin_,) = found["by_distance"]["trained"]
    assert (bin_["from_m"], bin_["samples"]) == (5.0, 6 * (STEPS - 6) - STEPS), "but what a lost camera would show"
    assert found["detections"]["unknown"]["range_error"] == pytest.approx(np.log(1.12) / 1.96, abs=1e-4)
    both = fit({"a": flight(position, rows(seen)), "b": unknown, "c": unknown}, {"a": 3, "b": 3, "c": REAL})
    assert both["detections"]["trained"]["missed"][0][1] == pytest.approx(0.05, rel=0.2), "each flight counts alike"


def test_a_wrong_range_is_neither_a_miss_nor_a_false_neighbour() -> None:
    """Of a drone 5 m away that seems 7.5 m away."""
    one = flight(
        np.tile([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]], (60, 1, 1)), [(step, 0, 1, 7.5, 0.1, 0.0) for step in range(60)]
    )
    assert one.missed[:, 0, 1].max() == len(one.false_m) == one.false_begun == 0
    assert one.log_range[:, 0, 1] == pytest.approx(np.log(1.5), abs=1e-3)


def test_who_comes_near_is_missed_from_three_seconds_later_on() -> None:
    """From 20 m away, by 4 m a step, to 4 m; known never, or from 8 m on; and one landed, below all cameras."""
    position = np.zeros((40, 2, 3))
    position[:, 1, 0] = np.maximum(4.0, 100.0 - 4.0 * np.arange(40.0))
    settled = flight(position, [(0, 0, 1, 90.0, 0.0, 0.0)]).settled[:, 0, 1]
    assert np.flatnonzero(settled)[0] + 6 == 29, "within 10 m from step 23 on"
    assert flight(position, [(23, 0, 1, 8.0, 0.0, 0.0)]).settled[:, 0, 1].argmax() + 6 == 23
    position[:, 1] = 1.0, 0.0, 5.0
    assert np.isnan(flight(position, [(0, 0, 1, 1.0, 0.0, 5.0)]).distance_m).all()


def test_detections_are_missed_more_often_than_tracks() -> None:
    """Which bridge 1.5 s: half of the drones missed for 3 s and more, for which the tracker's own flights are asked."""
    (for_long,), (shorter,) = detections_missed([0.2], 30.0), detections_missed([0.2], 3.0)
    assert 0.2 <= for_long < shorter - 0.04 < 0.46


def test_of_a_distance_at_which_few_were_seen_misses_are_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perceived_errors, "detections_missed", lambda shares, lasts_s: shares)
    bins = [
        {"from_m": low, "to_m": high, "samples": samples, "missed": missed}
        for low, high, samples, missed in ((4, 5, 300, 0.1), (5, 7, 30, 0.4), (7, 10, 29, 0.0))
    ]
    assert missed_at(bins, 3.0) == [[4.5, 0.1], [6.0, 0.4], [7, 0.4]]

"""What flights tell of the errors of perception: of one whose errors are made up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flockd.review.flight_log.log import FlightLog
from tools.measure.perceived_errors import fit, samples_of

STEP_S, STEPS = 0.5, 6000


def lasting(random: np.random.Generator, time_s: float) -> Any:
    """(S, 3, 3) of standard deviation 1."""
    keep, found = np.exp(-STEP_S / time_s), random.normal(size=(STEPS, 3, 3))
    for k in range(1, STEPS):
        found[k] = keep * found[k - 1] + np.sqrt(1 - keep**2) * found[k]
    return found


def test_errors_misses_and_false_neighbours_are_measured_as_they_were_made_up() -> None:
    """Three 6 m apart, whose headings are wrong by 2 degrees; ranges err by 5 % for 2 s, bearings by 0.03, a tenth is
    missed for 2 s and less, and one drone has a false neighbour 4 m away in every tenth step, each time another."""
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
    false_at = np.arange(6, STEPS, 10)
    tracked = [(step, 0, 100 + step, 0.0, 4.0, 0.0) for step in false_at]
    log = SimpleNamespace(
        time_s=STEP_S * np.arange(STEPS), position=position, neighbour_position=seen, has_truth=True,
        recorded=np.ones((STEPS, 3), bool), tracked=np.array(tracked),
        false_tracks=np.isin(np.arange(STEPS), false_at)[:, None] * [1, 0, 0],
        metadata=SimpleNamespace(by_sight=True, step_s=STEP_S, scenario="two"),
    )  # fmt: skip
    found = fit({"two-1": samples_of(cast(FlightLog, log))}, {"two-1": 3})
    like = found["detections"]
    assert like["range_error"] == pytest.approx(0.05, rel=0.1)
    assert like["bearing_error_rad"] == pytest.approx(0.03, rel=0.1)
    assert like["missed"] == pytest.approx(0.1, rel=0.2)
    assert like["error_time_s"] == pytest.approx(2.0, rel=0.2)
    assert 0.3 < like["missed_time_s"] < 2.0, "one who is missed for 2 s is not always missed"
    assert like["false_at_once"] == pytest.approx(0.1 / 3, rel=0.01)
    assert (like["false_time_s"], like["false_m"]) == (0.5, [4.0, 4.0, 4.0])
    (bin_,) = found["by_distance"]
    assert (bin_["from_m"], bin_["samples"]) == (5.0, 6 * (STEPS - 6))
    assert found["by_airframe"][3]["samples"] == 6 * (STEPS - 6)

"""The table of a distance network's errors, drone by drone. Needs the extra `train`."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from flockd.flight.inference import OnnxModel
from tools.measure.evaluate_crops import rows


class _Says:
    """A network that answers with the truth, ranges ``off`` times as long."""

    def __init__(self, crops: dict[str, NDArray[Any]], off: float) -> None:
        n = len(crops["drone"])
        logit, sigma = np.where(crops["drone"] > 0.5, 5.0, -5.0), np.full(n, np.log(0.15))
        first = crops["target"][:, 0] + np.log(off)
        self._out = np.stack([first, *np.zeros((2, n)), sigma, logit, crops["apparent"], np.full(n, -9.0)], 1)

    def run(self, feeds: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        part, self._out = np.split(self._out, [len(feeds["picture"])])
        return {"range": part}


def test_ranges_that_are_a_fifth_too_long_are_said_to_be_so_of_every_drone() -> None:
    n = 130
    crops: dict[str, NDArray[Any]] = {
        "picture": np.zeros((n, 96, 96, 3), np.uint8), "target": np.zeros((n, 3)), "apparent": np.full(n, np.log(70.0)),
        "drone": np.arange(n) < 120, "family": np.where(np.arange(n) < 60, 3, 30_000),
        "whole": np.ones(n, bool), "range_m": np.where(np.arange(n) % 2 == 0, 3.0, 9.0),
    }  # fmt: skip
    table = list(rows(cast(OnnxModel, _Says(crops, 1.2)), crops))
    assert [row[:2] for row in table] == [
        ("all", "60"), ("family 3", "30"), ("Holybro X500 V2", "30"), ("none", "10")
    ]  # fmt: skip
    for row in table[:3]:
        assert row[2:] == ("20.0 %", "20.0 %", "+20.0 %", "0.0 %", "0 %, 100 %", "100 %")
    assert table[3][-1] == "0.0 %"

"""What is said of a distance network on held-out crops. Needs the extra `train`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flockd.core.data import data_path
from tools.measure import evaluate_crops
from tools.measure.evaluate_crops import held_out, measured

COUNT = 40
SIZES_M = np.where(np.arange(COUNT) < 20, 0.5, 1.0)


def _write(folder: Path, **more: NDArray[Any]) -> None:
    """Drones that appear 70 px large, of two sizes, half of them near; the last four are none."""
    zeros = np.zeros(COUNT)
    np.savez(
        folder / "a.npz", picture=np.zeros((COUNT, 96, 96, 3), np.uint8), apparent=np.full(COUNT, np.log(70.0)),
        target=np.stack([np.log(SIZES_M / 70.0), zeros, zeros], 1), drone=np.arange(COUNT) < 36,
        allow_pickle=False, **more,
    )  # fmt: skip


def test_ranges_that_are_a_fifth_too_long_are_said_to_be_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write(tmp_path, whole=np.arange(COUNT) < 36, range_m=np.where(np.arange(COUNT) % 2 == 0, 3.0, 7.0))
    crops, none = held_out(tmp_path)
    assert (len(crops["picture"]), len(none)) == (36, 4)
    assert np.exp(crops["apparent"] + crops["target"][:, 0]) == pytest.approx(SIZES_M[:36])

    def columns(_: object, pictures: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """A network that says 1.2 times the range, 70 px, and 15 % of deviation; and of none that it is none."""
        n = len(pictures)
        ours = crops["target"][:, 0] + np.log(1.2) if n == 36 else np.zeros(n)
        values = {"log_range_per_focal": ours, "log_apparent_size": np.full(n, np.log(70.0))}
        logit = np.full(n, 9.0 if n == 36 else -9.0)
        return values | {"log_relative_sigma": np.full(n, np.log(0.15)), "drone_logit": logit}

    monkeypatch.setattr(evaluate_crops, "_columns", columns)
    figures = measured(data_path("models") / "distance_int8.yaml", crops, none)
    for metres in ("1.5-5", "5-10"):
        assert figures[f"error of range, {metres} m, median / p95 / bias"] == "20.00% / 20.00% / +20.00%"
        assert figures[f"error of range by the known size, {metres} m, median / p95 / bias"].startswith("0.00% / 0.00%")
    assert figures["errors inside 1 and 2 sigma"] == "0%, 100%"
    assert figures["drones called a drone"] == "100.0%"
    assert figures["crops without a drone called one"] == "0.0%"


def test_crops_without_ranges_are_refused(tmp_path: Path) -> None:
    _write(tmp_path)
    with pytest.raises(ValueError, match=r"holds no crops with ranges; make them with `render_drone_crops --held-out`"):
        held_out(tmp_path)

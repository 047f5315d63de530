"""Real airframes and shells as drones of the renderer. Needs the extra `train`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tools.measure.cycles.jobs import airframe_file
from tools.training.airframes import airframe_models
from tools.training.cutouts.shells import KINDS
from tools.training.cutouts.sources import HELD_OUT, SOURCES, TRAINING

HUBS = np.array([[0.2, 0.2, 0.0], [0.2, -0.2, 0.0], [-0.2, -0.2, 0.0], [-0.2, 0.2, 0.0]])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of each name a tetrahedron of 10 cm with four propellers of 10 cm radius."""
    corners = np.array([[0.05, 0.0, 0.0], [-0.05, 0.05, 0.0], [-0.05, -0.05, 0.0], [0.0, 0.0, 0.05]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    for name in SOURCES:
        np.savez(
            airframe_file(tmp_path, name), vertices=corners, triangles=faces, colours=np.full((4, 3), 0.2), hubs=HUBS,
            radii=np.full(4, 0.1), allow_pickle=False,
        )  # fmt: skip
    return tmp_path


def test_a_real_drone_measures_from_tip_to_tip_and_has_its_motors_where_they_are(folder: Path) -> None:
    for (model,) in airframe_models(folder, 1, np.random.default_rng(0))[: len(TRAINING)]:
        assert model.size_m == pytest.approx(0.4 * np.sqrt(2) + 0.2, abs=2e-3)
        assert np.array_equal(model.hubs, HUBS)
        reach = np.linalg.norm(model.vertices[:, :2], axis=1).max()
        assert reach == pytest.approx(model.size_m / 2, rel=0.35)  # a propeller that stands may lie across its arm


def test_what_is_held_out_is_never_among_those_that_are_learnt_from(folder: Path) -> None:
    learnt = {shape[0].family for shape in airframe_models(folder, 2, np.random.default_rng(0))}
    held_out = {shape[0].family for shape in airframe_models(folder, 2, np.random.default_rng(0), held_out=True)}
    assert len(learnt) == len(TRAINING) + len(KINDS)
    assert len(held_out) == len(HELD_OUT)
    assert not learnt & held_out

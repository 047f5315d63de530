from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from tools.training.cutouts import drones, plan, shells
from tools.training.cutouts.sources import HELD_OUT, SOURCES, TRAINING
from tools.training.drone_generator import generated_drone
from tools.training.render_cutouts import _files_in


def test_what_is_drawn_follows_from_the_seed_and_no_held_out_airframe_is_among_it() -> None:
    scenes = [plan.scene(0, k) for k in range(600)]
    assert scenes[:20] == [plan.scene(0, k) for k in range(20)]
    assert not {one.name for one in scenes} & set(HELD_OUT)
    for kind, share in plan.KINDS.items():
        assert np.mean([one.kind == kind for one in scenes]) == pytest.approx(share, abs=0.06)
    assert {plan.scene(0, k, held_out=True).name for k in range(5)} == set(HELD_OUT)
    assert set(TRAINING) | set(HELD_OUT) == set(SOURCES)


def test_views_are_of_every_side_and_most_of_them_level() -> None:
    views = [view for k in range(300) for view in plan.scene(1, k).views]
    degrees = np.degrees([view.elevation for view in views])
    assert 0.8 < np.mean(np.abs(degrees) <= 50.0) < 0.98
    assert (degrees.min() < -65.0, degrees.max() > 65.0) == (True, True)
    assert all(plan.RANGES_M[0] <= view.range_m <= plan.RANGES_M[1] for view in views)
    assert max(abs(view.roll) for view in views) <= math.radians(25.0)


# Diagonal between motors as makers publish it, with the generator's margin; tip to tip.
@pytest.mark.parametrize(
    ("kind", "between_m", "size_m"),
    [
        ("Phantom-like", (0.33, 0.37), (0.55, 0.64)),
        ("Mavic-like", (0.30, 0.41), (0.50, 0.65)),
        ("Mini-like", (0.18, 0.27), (0.30, 0.42)),
        ("Inspire-like", (0.54, 0.63), (0.85, 1.02)),
        ("FPV-like", (0.20, 0.27), (0.31, 0.41)),
    ],
)
def test_a_shell_is_of_its_makers_size(kind: str, between_m: tuple[float, float], size_m: tuple[float, float]) -> None:
    for seed in range(12):
        drone = drones.shell_drone(kind, seed)
        assert between_m[0] <= drone.airframe.between_motors_m <= between_m[1]
        assert size_m[0] <= drone.airframe.size_m <= size_m[1]
    assert 0.3 < np.mean([shells.shell(kind, seed).is_white for seed in range(60)]) < 0.7


def test_a_generated_drone_loses_its_propellers_and_keeps_its_size() -> None:
    for number in range(8):
        made = drones.generated(number, 3, np.random.default_rng(number))
        model = generated_drone(number, 3)
        tips = max(
            float(np.linalg.norm(a.hub[:2] - b.hub[:2])) + a.radius_m + b.radius_m
            for a in made.airframe.rotors
            for b in made.airframe.rotors
        )
        assert tips == pytest.approx(model.size_m, rel=1e-3)
        assert len(made.airframe.triangles) < len(model.triangles)


def test_a_line_that_a_crash_cut_off_is_rendered_again(tmp_path: Path) -> None:
    index = tmp_path / "index.jsonl"
    index.write_text(json.dumps({"file": "00000_0.png"}) + "\n" + '{"file": "000')
    assert _files_in(index) == {"00000_0.png"}
    assert index.read_text().endswith("}\n")

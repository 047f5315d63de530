"""Configurations that were changed anywhere end in one of flockd's sentences."""

from __future__ import annotations

import shutil
from pathlib import Path
from random import Random

from flockd.flight.geometry import build_rig
from flockd.sim.scenario import load_with_places
from tests.hostile import CORPUS, ROOT, hostile, own_errors, put, text_of


def test_a_changed_configuration_is_read_or_refused(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "config", tmp_path, dirs_exist_ok=True)
    small = [path.read_text(encoding="utf-8") for path in sorted(CORPUS.glob("*.yaml"))]
    shipped = [path.read_text(encoding="utf-8") for path in sorted(tmp_path.glob("*.yaml"))]
    texts = [*small * 4, *shipped]  # the large ones are parsed slowly
    file = tmp_path / "mutated.yaml"

    @hostile(12)
    def check(random: Random) -> None:
        put(random, file, lambda: text_of(random, texts))
        with own_errors():
            config, _ = load_with_places(file)
            drone = config.drone if hasattr(config, "drone") else config
            build_rig(drone.rig)

    check()

"""Manifests that were changed anywhere end in one of flockd's sentences."""

from __future__ import annotations

from pathlib import Path
from random import Random

from flockd.flight.inference import read_manifest
from flockd.flight.perception.requirements import check_roles
from tests.hostile import ROOT, hostile, own_errors, put, text_of


def test_a_changed_manifest_is_read_or_refused(tmp_path: Path) -> None:
    texts = [path.read_text(encoding="utf-8") for path in sorted((ROOT / "models").glob("*.yaml"))]
    for name in {line.partition(": ")[2] for text in texts for line in text.splitlines() if line.startswith("file: ")}:
        (tmp_path / name).write_bytes(b"no network")
    file = tmp_path / "mutated.yaml"

    @hostile(25)
    def check(random: Random) -> None:
        put(random, file, lambda: text_of(random, texts))
        with own_errors():
            read_manifest(file, check_roles).check_model()

    check()

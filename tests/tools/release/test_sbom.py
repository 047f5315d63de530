"""The software bill of materials: what is added to that of cyclonedx-py; the same each time."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

from tools.release.sbom import completed, main

ROOT = Path(__file__).parents[3]


def bill() -> dict[str, Any]:
    """As cyclonedx-py 7.5 writes it, with two packages."""
    packages = [
        {"type": "library", "bom-ref": f"{name}==1", "name": name, "version": "1"} for name in ("numpy", "protobuf")
    ]
    edges = [{"ref": "numpy==1"}, {"ref": "protobuf==1"}, {"ref": "root", "dependsOn": ["numpy==1", "protobuf==1"]}]
    itself = {"type": "application", "bom-ref": "root", "name": "flockd"}
    return {"bomFormat": "CycloneDX", "metadata": {"component": itself}, "components": packages, "dependencies": edges}


def test_it_lists_every_network_with_the_hash_of_its_file() -> None:
    networks = {one["name"]: one for one in completed(bill())["components"] if one["type"] == "machine-learning-model"}
    files = {path.stem: hashlib.sha256(path.read_bytes()).hexdigest() for path in (ROOT / "models").glob("*.onnx")}
    assert {name: one["hashes"][0]["content"] for name, one in networks.items()} == files


def test_a_licence_that_metadata_leave_open_is_said() -> None:
    packages = {one["name"]: one for one in completed(bill())["components"]}
    assert packages["protobuf"]["licenses"] == [{"expression": "BSD-3-Clause"}]
    assert "licenses" not in packages["numpy"]


def test_flockd_needs_every_component_and_the_file_is_the_same_each_time(tmp_path: Path) -> None:
    written = []
    for name in ("a.json", "b.json"):
        (tmp_path / name).write_text(json.dumps(bill()), encoding="utf-8")
        main(tmp_path / name)
        written.append((tmp_path / name).read_text(encoding="utf-8"))
    assert written[0] == written[1]
    found = json.loads(written[0])
    assert re.fullmatch(r"urn:uuid:[0-9a-f-]{36}", found["serialNumber"])
    edges = {one["ref"]: one["dependsOn"] for one in found["dependencies"]}
    assert set(edges["root"]) == {one["bom-ref"] for one in found["components"]}

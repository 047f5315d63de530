"""The software bill of materials: every package of the lock and every network, with licences; the same each time."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

from tools.release import sbom
from tools.release.lock import LOCK, pins

ROOT = Path(__file__).parents[3]


def test_it_lists_every_package_with_version_and_licence() -> None:
    libraries = {one["name"]: one for one in sbom.document()["components"] if one["type"] == "library"}
    locked = {pin.name: pin.version for pin in pins(LOCK.read_text(encoding="utf-8")) if pin.name != "setuptools"}
    assert {name: one["version"] for name, one in libraries.items()} == locked
    assert libraries["numpy"]["purl"] == f"pkg:pypi/numpy@{locked['numpy']}"
    assert libraries["pyyaml"]["licenses"] == [{"expression": "MIT"}]


def test_it_lists_every_network_with_the_hash_of_its_file() -> None:
    networks = {one["name"]: one for one in sbom.document()["components"] if one["type"] == "machine-learning-model"}
    files = {path.stem: hashlib.sha256(path.read_bytes()).hexdigest() for path in (ROOT / "models").glob("*.onnx")}
    assert {name: one["hashes"][0]["content"] for name, one in networks.items()} == files


def test_every_reference_leads_to_a_component() -> None:
    bill = sbom.document()
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    assert re.fullmatch(r"urn:uuid:[0-9a-f-]{36}", bill["serialNumber"])
    known = {one["bom-ref"] for one in [*bill["components"], bill["metadata"]["component"]]}
    edges = {one["ref"]: set(one["dependsOn"]) for one in bill["dependencies"]}
    reached, waiting = set[str](), [bill["metadata"]["component"]["bom-ref"]]
    while waiting:
        ref = waiting.pop()
        if ref not in reached:
            reached.add(ref)
            waiting.extend(edges.get(ref, ()))
    assert reached == known, "everything in it is needed by something"


def test_it_is_written_the_same_each_time(tmp_path: Path) -> None:
    for name in ("a.json", "b.json"):
        assert sbom.main(["--out", str(tmp_path / name)]) == 0
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == sbom.document()

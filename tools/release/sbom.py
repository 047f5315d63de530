"""Write the software bill of materials: what is in an installed flockd, as CycloneDX 1.6 in JSON.

python -m tools.release.sbom                       # out/flockd.cdx.json
python -m tools.release.sbom --out release.json

Made anew for each release, from what the tree holds then, and never kept in it: every package of
requirements/service.txt with version and licence, and every network of models/ with hash and licence. Licences and who
needs whom come from the installed packages' metadata. The same tree and packages give the same file.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tomllib
import uuid
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

from flockd import __version__
from flockd.flight.inference import find_manifests, read_manifest
from tools.release.licences import Licence, declared_packages, licence_of, needed_by, runtime_packages
from tools.release.lock import LOCK, Pin, pins

ROOT = Path(__file__).resolve().parents[2]
DEFAULT = Path("out/flockd.cdx.json")
Json = dict[str, Any]


def document() -> Json:
    """The bill. Raises PackageNotFoundError where a package of the lock is not installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lock = LOCK.read_bytes()
    run_time = set(runtime_packages())
    locked = [pin for pin in pins(lock.decode()) if pin.name in run_time]
    itself: Json = {
        "type": "application",
        "bom-ref": f"pkg:generic/flockd@{__version__}",
        "name": "flockd",
        "version": __version__,
        "licenses": [{"expression": project["license"]}],
    }
    networks = list(_networks())
    digest = hashlib.sha256(lock).hexdigest()
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_OID, json.dumps([digest, networks]))}",
        "version": 1,
        "metadata": {
            "component": itself,
            "properties": [{"name": "flockd:lock:sha256", "value": digest}],
        },
        "components": [*(_package(pin, licence_of(pin.name)) for pin in locked), *networks],
        "dependencies": list(_dependencies(itself["bom-ref"], locked, networks)),
    }


def _purl(pin: Pin) -> str:
    return f"pkg:pypi/{pin.name}@{pin.version}"


def _package(pin: Pin, licence: Licence) -> Json:
    """A package of the lock. What it has of another installed version is said."""
    said = {
        "type": "library",
        "bom-ref": _purl(pin),
        "name": pin.name,
        "version": pin.version,
        "purl": _purl(pin),
        "licenses": [{"expression": licence.expression}],
    }
    properties = {"flockd:marker": pin.marker} if pin.marker else {}
    if licence.version != pin.version:
        properties["flockd:licence-of-version"] = licence.version
    if properties:
        said["properties"] = [{"name": name, "value": value} for name, value in properties.items()]
    return said


def _networks() -> Iterator[Json]:
    for path in find_manifests(ROOT / "models"):
        manifest = read_manifest(path).manifest
        yield {
            "type": "machine-learning-model",
            "bom-ref": f"flockd:network:{manifest.name}",
            "name": manifest.name,
            "description": manifest.description,
            "hashes": [{"alg": "SHA-256", "content": manifest.sha256}],
            "licenses": [{"expression": manifest.licence}],
        }


def _dependencies(itself: str, locked: Sequence[Pin], networks: Sequence[Json]) -> Iterator[Json]:
    declared = declared_packages()
    first = [_purl(pin) for pin in locked if pin.name in declared]
    yield {"ref": itself, "dependsOn": [*first, *(network["bom-ref"] for network in networks)]}
    for pin in locked:
        needed = set(needed_by(pin.name))
        yield {"ref": _purl(pin), "dependsOn": [_purl(other) for other in locked if other.name in needed]}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", metavar="FILE", type=Path, default=DEFAULT, help=f"default: {DEFAULT}")
    out: Path = parser.parse_args(arguments).out
    try:
        bill = document()
    except PackageNotFoundError as error:
        print(f"sbom: {error.name} is not installed; `pip install -r requirements/service.txt`", file=sys.stderr)
        return 69
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(bill, indent=1) + "\n", encoding="utf-8")
    print(f"{out}: {len(bill['components'])} components")
    return 0


if __name__ == "__main__":
    sys.exit(main())

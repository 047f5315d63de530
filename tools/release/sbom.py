"""Complete the software bill of materials that cyclonedx-py writes of an environment (`make sbom`).

python -m tools.release.sbom out/flockd.cdx.json

cyclonedx-py knows the packages and who needs whom. Added here: flockd's version, the networks of models/ with hash and
licence, the licences that metadata do not say (`STATED`), and a serial number. The same tree and packages give the same
file.
"""

from __future__ import annotations

import json
import sys
import uuid
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name

from flockd import __version__
from flockd.flight.inference import find_manifests, read_manifest
from tools.release.licences import STATED
from tools.release.wheels import ROOT


def completed(bill: dict[str, Any]) -> dict[str, Any]:
    """The bill with what cyclonedx-py does not know."""
    itself = bill["metadata"]["component"] | {"version": __version__}
    packages = bill["components"]
    for one in packages:
        if (name := canonicalize_name(one["name"])) in STATED:
            one["licenses"] = [{"expression": STATED[name]}]
    networks = [
        {
            "type": "machine-learning-model",
            "bom-ref": f"flockd:network:{manifest.name}",
            "name": manifest.name,
            "description": manifest.description,
            "hashes": [{"alg": "SHA-256", "content": manifest.sha256}],
            "licenses": [{"expression": manifest.licence}],
        }
        for manifest in (read_manifest(path).manifest for path in find_manifests(ROOT / "models"))
    ]
    components = packages + networks
    edges = {one["ref"]: one.get("dependsOn", []) for one in bill["dependencies"]}
    edges[itself["bom-ref"]] = [*edges.get(itself["bom-ref"], []), *(network["bom-ref"] for network in networks)]
    return bill | {
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_OID, __version__ + json.dumps(components))}",
        "metadata": bill["metadata"] | {"component": itself},
        "components": components,
        "dependencies": [{"ref": ref, "dependsOn": needed} for ref, needed in edges.items()],
    }


def main(out: Path) -> None:
    """Rewrites the file."""
    bill = completed(json.loads(out.read_text(encoding="utf-8")))
    out.write_text(json.dumps(bill, indent=1) + "\n", encoding="utf-8")
    print(f"{out}: {len(bill['components'])} components")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

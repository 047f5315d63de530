"""What flockd imports, its installation brings: nothing is there only because another package needs it."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
DISTRIBUTIONS = {
    "cv2": "opencv-python-headless",
    "yaml": "pyyaml",
    "zenoh": "eclipse-zenoh",
    "rclpy": "ros-rclpy",
    "google": "protobuf",
    "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
    "pydantic_core": "pydantic-core",
}
"""Where a package is imported by another name than it is installed by."""


def _imported() -> Iterator[str]:
    for path in (ROOT / "flockd").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from (alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                yield node.module.partition(".")[0]


def test_every_package_that_is_imported_is_declared() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    flown = [
        *project["dependencies"],
        *(one for name in extras if name not in ("train", "test", "browser") for one in extras[name]),
    ]
    declared = {re.split(r"[<>=\[; ]", one)[0].lower() for one in flown}
    imported = set(_imported()) - sys.stdlib_module_names - {"flockd"}
    assert {"numpy", "cv2", "zstandard"} <= imported, "the search finds imports"
    assert {DISTRIBUTIONS.get(name, name).lower() for name in imported} - declared == set()

"""What flockd imports, its installation brings: nothing is there only because another package needs it."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from flockd.cli import EXTRAS

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


def _declared(section: str) -> set[str]:
    """Distributions that an extra brings, or `dependencies`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    of = {**project["optional-dependencies"], "dependencies": project["dependencies"]}
    return {re.split(r"[<>=\[; ]", one)[0].lower() for one in of[section]}


EXTRAS_OF_COMMANDS = ("sim", "campaign", "openvino", "fleet", "ros", "bags", "models", "completion")


def test_every_package_that_is_imported_is_declared() -> None:
    declared = set[str]().union(*map(_declared, ("dependencies", *EXTRAS_OF_COMMANDS)))
    imported = set(_imported()) - sys.stdlib_module_names - {"flockd"}
    assert {"numpy", "cv2", "zstandard"} <= imported, "the search finds imports"
    assert {DISTRIBUTIONS.get(name, name).lower() for name in imported} - declared == set()


@pytest.mark.parametrize("extra", ["sim", "campaign", "fleet", "bags", "models", "completion"])
def test_a_command_that_lacks_an_extra_names_it(extra: str) -> None:
    """openvino and ROS 2 are asked for where they are used, with sentences of their own."""
    told = {DISTRIBUTIONS.get(module, module) for module, its in EXTRAS.items() if its == extra}
    assert told >= _declared(extra) - {"flockd"}

"""`from flockd import ...`: the names that other programs may rely on, loaded when they are first used."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import flockd

OFFERED = {
    "FlockPilot", "Perception", "PictureDetector", "Tracker", "FlockingLaw", "Gate", "load_drone", "load_networks",
    "Recording", "PinholeCamera", "RigidTransform", "fit_rigid", "ransac_rigid",
}  # fmt: skip
"""What has been promised; what they take and give is offered beside them."""


def test_importing_flockd_loads_no_library() -> None:
    script = "import sys; before = set(sys.modules); import flockd; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert "flockd" in loaded
    assert loaded - sys.stdlib_module_names == {"flockd"}


def test_the_package_runs_as_the_program() -> None:
    done = subprocess.run([sys.executable, "-m", "flockd", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == flockd.__version__


@pytest.mark.parametrize("name", flockd.__all__)
def test_a_name_is_what_its_module_defines(name: str) -> None:
    value = getattr(flockd, name)
    assert value.__name__ == name
    assert value.__module__.startswith("flockd.")
    assert value.__doc__


def test_what_was_promised_is_offered() -> None:
    assert set(flockd.__all__) >= OFFERED
    assert set(dir(flockd)) >= {*flockd.__all__, "__version__"}


def test_type_checkers_see_the_same_names_from_the_same_modules() -> None:
    tree = ast.parse(Path(flockd.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    assert {node.module: tuple(one.name for one in node.names) for node in imports} == flockd._HOMES
    assert sorted(name for names in flockd._HOMES.values() for name in names) == sorted(flockd.__all__)

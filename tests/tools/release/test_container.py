"""The container's recipe: it installs the lock, from files that the tree has and its ignore list lets through."""

from __future__ import annotations

import re

import pytest

from tools.release.wheels import ROOT, SOURCES

RECIPE = (ROOT / "Containerfile").read_text(encoding="utf-8")
ROS_RECIPE = (ROOT / "packaging" / "ros" / "Containerfile").read_text(encoding="utf-8")


def test_it_installs_the_lock_by_its_hashes_and_flockd_without_anything_else() -> None:
    installs = re.findall(r"/pip install (.*?)(?: \\)?$", RECIPE, re.MULTILINE)
    assert installs == [
        "--no-cache-dir --require-hashes -r /tmp/service.txt",
        "--no-cache-dir --no-deps --no-build-isolation /tmp/flockd",
    ]
    assert "COPY requirements/service.txt /tmp/service.txt\n" in RECIPE


def test_that_of_ros_installs_the_lock_too_and_then_the_extra() -> None:
    installs = re.findall(r"/pip install (.*?)(?: \\)?$", ROS_RECIPE, re.MULTILINE)
    assert installs == [
        "--no-cache-dir --require-hashes -r /tmp/service.txt",
        "--no-cache-dir '/tmp/flockd[ros]'",
    ]
    assert "debian:12-slim" in ROS_RECIPE, "whose Python is the wheels' 3.11"


@pytest.mark.parametrize("recipe", [RECIPE, ROS_RECIPE])
def test_it_flies_as_nobody_special(recipe: str) -> None:
    assert re.findall(r"^USER (.*)$", recipe, re.MULTILINE) == ["flockd"]
    assert recipe.index("USER flockd") < recipe.index("ENTRYPOINT")


def test_the_ignore_list_lets_through_what_building_needs() -> None:
    lines = (ROOT / ".containerignore").read_text(encoding="utf-8").splitlines()
    assert {line[1:] for line in lines if line.startswith("!")} == set(SOURCES)

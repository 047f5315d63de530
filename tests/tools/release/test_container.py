"""The containers' recipes: they install the lock, from files that the tree has and the ignore list lets through."""

from __future__ import annotations

import re

import pytest

from tools.release.wheels import ROOT, SOURCES


@pytest.mark.parametrize(
    ("recipe", "flockd"),
    [
        ("Containerfile", "--no-cache-dir --no-deps --no-build-isolation /tmp/flockd"),
        ("packaging/ros/Containerfile", "--no-cache-dir '/tmp/flockd[ros]'"),
    ],
)
def test_it_installs_the_lock_by_its_hashes_then_flockd_and_flies_as_nobody_special(recipe: str, flockd: str) -> None:
    text = (ROOT / recipe).read_text(encoding="utf-8")
    installs = re.findall(r"/pip install (.*?)(?: \\)?$", text, re.MULTILINE)
    assert installs == ["--no-cache-dir --require-hashes -r /tmp/service.txt", flockd]
    assert re.findall(r"^USER (.*)$", text, re.MULTILINE) == ["flockd"]
    assert text.index("USER flockd") < text.index("ENTRYPOINT")


def test_the_ignore_list_lets_through_what_building_needs() -> None:
    lines = (ROOT / ".containerignore").read_text(encoding="utf-8").splitlines()
    assert {line[1:] for line in lines if line.startswith("!")} == set(SOURCES)

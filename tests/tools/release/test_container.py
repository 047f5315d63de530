"""The container's recipe: it installs the lock, from files that the tree has and its ignore list lets through."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from flockd import __version__
from tools.release import check_container
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


@pytest.fixture
def builder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A `buildah` that writes down how it is called, and fails at the recipe that has the word of `fails`."""
    script = tmp_path / "bin" / "buildah"
    script.parent.mkdir()
    script.write_text(
        "#!/bin/sh\n"
        'echo "$*" >> "$0.calls"\n'
        'case "$*" in *--file*) recipe="$(cat)" ;; esac\n'
        'test ! -e "$0.fails" || ! echo "$recipe" | grep -q "$(cat "$0.fails")"\n'
    )
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{script.parent}:/usr/bin:/bin")
    monkeypatch.setattr(check_container, "BUILDERS", ("buildah",))
    return script


def _check(monkeypatch: pytest.MonkeyPatch, packages: Path) -> int:
    monkeypatch.setattr(sys, "argv", ["check_container", "--packages", str(packages), "--base", "base"])
    return check_container.main()


def test_image_and_package_are_built_in_the_base_that_was_asked_for(
    builder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for architecture in ("amd64", "arm64"):
        (tmp_path / f"flockd_{__version__}+debian12_{architecture}.deb").touch()
    assert _check(monkeypatch, tmp_path) == 0
    image, flight, package = Path(f"{builder}.calls").read_text().splitlines()
    assert "--build-arg BASE=base" in image
    assert f"--tag localhost/flockd:{__version__}" in image
    assert flight.endswith("tests/review/replay")
    assert package.endswith(str(tmp_path))


@pytest.mark.parametrize("step", ["models verify", "purge"])
def test_a_step_that_fails_in_an_image_fails_the_release(
    builder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    (tmp_path / f"flockd_{__version__}+debian12_amd64.deb").touch()
    (tmp_path / f"flockd_{__version__}+debian12_arm64.deb").touch()
    Path(f"{builder}.fails").write_text(step)
    with pytest.raises(SystemExit, match="ended with exit code 1"):
        _check(monkeypatch, tmp_path)


def test_without_a_package_it_says_which_and_how(
    builder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit, match=r"no package of .* and Debian 12 in .*; make deb"):
        _check(monkeypatch, tmp_path)

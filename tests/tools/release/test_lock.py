"""The lock of the service's installation: it fits pyproject.toml, is whole, and refuses a file that was changed."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tools.release.licences import runtime_packages
from tools.release.lock import LOCK, inputs, pins

TEXT = LOCK.read_text(encoding="utf-8")
PINS = pins(TEXT)
OUT_OF_DATE = "requirements/service.txt does not fit pyproject.toml: run python -m tools.release.lock"


@pytest.mark.parametrize("wanted", inputs())
def test_each_requirement_is_locked_to_a_version_that_fits(wanted: str) -> None:
    requirement = Requirement(wanted)
    versions = [pin.version for pin in PINS if pin.name == canonicalize_name(requirement.name)]
    assert len(versions) == 1, OUT_OF_DATE
    assert requirement.specifier.contains(versions[0]), OUT_OF_DATE


def test_it_holds_what_is_needed_and_nothing_else() -> None:
    build = {canonicalize_name(Requirement(one).name) for one in inputs()} - set(runtime_packages())
    assert build == {"setuptools"}
    assert {pin.name for pin in PINS} == {*runtime_packages(), *build}, OUT_OF_DATE


def test_it_has_one_version_of_each_for_every_python_and_system() -> None:
    assert [pin.name for pin in PINS] == sorted({pin.name for pin in PINS})
    assert [pin for pin in PINS if pin.marker] == []


def test_it_takes_wheels_only_and_names_no_place_that_they_come_from() -> None:
    assert "\n--only-binary :all:\n" in TEXT
    assert re.findall(r"://|\b[\w.]+\.(?:org|com|net|io)\b|index-url|find-links|trusted-host|-e |git\+", TEXT) == []


@pytest.mark.parametrize("line", ["numpy>=2", "numpy==2.4.6", "numpy @ file:///tmp/numpy.whl", "--index-url x"])
def test_a_line_without_version_and_hash_is_no_lock(line: str) -> None:
    with pytest.raises(ValueError, match=re.escape(line[:5])):
        pins(line)


def installed(wheels: Path, requirements: str, target: Path) -> subprocess.CompletedProcess[str]:
    """What the documented command does with an index that has only these wheels."""
    file = wheels / "requirements.txt"
    file.write_text(requirements, encoding="utf-8")
    command = [sys.executable, "-m", "pip", "--isolated", "install", "--disable-pip-version-check", "--no-index"]
    command += ["--no-deps", f"--find-links={wheels}", f"--target={target}", "--require-hashes", "-r", str(file)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_package_that_is_not_the_one_that_was_locked_is_refused(tmp_path: Path) -> None:
    """An index serves another file under the name and version of one of the lock."""
    pin = next(pin for pin in PINS if pin.name == "mdurl")
    info = f"{pin.name}-{pin.version}.dist-info"
    wheel = tmp_path / f"{pin.name}-{pin.version}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("mdurl.py", "raise SystemExit('not the one that was tested')\n")
        archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {pin.name}\nVersion: {pin.version}\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    entry = re.search(r"^mdurl==.*?(?=^\S)", TEXT, re.DOTALL | re.MULTILINE)
    assert entry is not None
    refused = installed(tmp_path, entry[0], tmp_path / "target")
    assert refused.returncode != 0
    assert "DO NOT MATCH THE HASHES" in refused.stderr
    assert not (tmp_path / "target" / "mdurl.py").exists()

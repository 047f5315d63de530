"""The lock of the service's installation: it fits pyproject.toml, is whole, and refuses a file that was changed."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tools.release.wheels import BUILD_ONLY, LOCK, ROOT, names_of_lock

TEXT = LOCK.read_text(encoding="utf-8")
PINS = dict(re.findall(r"^([a-z0-9-]+)==(\S+)", TEXT, re.MULTILINE))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
DIRECT = [*PROJECT["project"]["dependencies"], *PROJECT["build-system"]["requires"]]
OUT_OF_DATE = "requirements/service.txt does not fit pyproject.toml: run `make lock`"


def needed(waiting: list[str]) -> set[str]:
    """These installed packages, and what they need without extras."""
    found: set[str] = set()
    while waiting:
        wanted = Requirement(waiting.pop())
        name = canonicalize_name(wanted.name)
        if name not in found and (wanted.marker is None or wanted.marker.evaluate({"extra": ""})):
            found.add(name)
            waiting += requires(name) or []
    return found


@pytest.mark.parametrize("wanted", DIRECT)
def test_each_requirement_is_locked_to_a_version_that_fits(wanted: str) -> None:
    requirement = Requirement(wanted)
    assert requirement.specifier.contains(PINS[canonicalize_name(requirement.name)]), OUT_OF_DATE


def test_it_holds_what_is_needed_and_nothing_else() -> None:
    assert set(names_of_lock()) == needed(list(PROJECT["project"]["dependencies"])) | {BUILD_ONLY}, OUT_OF_DATE


def test_it_has_one_version_of_each_for_every_python_and_system_with_hashes() -> None:
    pinned = re.findall(r"^(\S+)==\S+( ; .*)? \\\n(?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+", TEXT, re.MULTILINE)
    assert pinned == [(name, "") for name in sorted(PINS)]


def test_it_takes_wheels_only_and_names_no_place_that_they_come_from() -> None:
    assert "\n--only-binary :all:\n" in TEXT
    assert re.findall(r"://|\b[\w.]+\.(?:org|com|net|io)\b|index-url|find-links|trusted-host|-e |git\+", TEXT) == []


def installed(wheels: Path, requirements: str, target: Path) -> subprocess.CompletedProcess[str]:
    """What the documented command does with an index that has only these wheels."""
    file = wheels / "requirements.txt"
    file.write_text(requirements, encoding="utf-8")
    command = [sys.executable, "-m", "pip", "--isolated", "install", "--disable-pip-version-check", "--no-index"]
    command += ["--no-deps", f"--find-links={wheels}", f"--target={target}", "--require-hashes", "-r", str(file)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_package_that_is_not_the_one_that_was_locked_is_refused(tmp_path: Path) -> None:
    """An index serves another file under the name and version of one of the lock."""
    version = PINS["mdurl"]
    info = f"mdurl-{version}.dist-info"
    wheel = tmp_path / f"mdurl-{version}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("mdurl.py", "raise SystemExit('not the one that was tested')\n")
        archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: mdurl\nVersion: {version}\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    entry = re.search(r"^mdurl==.*?(?=^\S)", TEXT, re.DOTALL | re.MULTILINE)
    assert entry is not None
    refused = installed(tmp_path, entry[0], tmp_path / "target")
    assert refused.returncode != 0
    assert "DO NOT MATCH THE HASHES" in refused.stderr
    assert not (tmp_path / "target" / "mdurl.py").exists()

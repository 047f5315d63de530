"""The wheels of the lock (`requirements/service.txt`) for a computer that is not this one, and flockd's own.

Needs pip alone. Every file is checked against the hash that the lock names.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LOCK = ROOT / "requirements" / "service.txt"
SOURCES = (
    *("flockd", "models", "config", "systemd", "requirements"),
    *("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE", "NOTICE"),
)
"""What building flockd needs of the tree."""
BUILD_ONLY = "setuptools"
OLDEST_GLIBC, NEWEST_GLIBC = 17, 28
"""2.17 is the oldest that wheels are made for, 2.28 the newest that the locked ones need: Debian 10 has it."""


def names_of_lock() -> list[str]:
    """The packages that the lock names, as indexes write them: lower case, with `-`."""
    return re.findall(r"^([a-z0-9-]+)==", LOCK.read_text(encoding="utf-8"), re.MULTILINE)


def copy_sources(target: Path) -> None:
    """Copies `SOURCES` into an existing folder, without what Python left in them."""
    for name in SOURCES:
        origin = ROOT / name
        if origin.is_dir():
            shutil.copytree(origin, target / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(origin, target / name)


def download(folder: Path, requirements: Sequence[str], *, machine: str, python: str) -> None:
    """Downloads wheels for Linux. ``machine``: as `uname -m` prints it; ``python``: such as "3.11".

    ``requirements`` are pip's: names, or `--requirement=FILE`. Raises CalledProcessError.
    """
    kinds = [f"--platform=manylinux_2_{minor}_{machine}" for minor in range(OLDEST_GLIBC, NEWEST_GLIBC + 1)]
    options = ["--quiet", "--only-binary=:all:", f"--python-version={python}", f"--platform=manylinux2014_{machine}"]
    _pip("download", *options, *kinds, f"--dest={folder}", *requirements)


def download_locked(folder: Path, *, machine: str, python: str) -> None:
    """Downloads what the lock names. Raises CalledProcessError."""
    download(folder, ["--require-hashes", f"--requirement={LOCK}"], machine=machine, python=python)


def locked(shelf: Path) -> list[Path]:
    """The wheels in a folder that the lock names, but for what only builds flockd. Raises StopIteration without one."""
    return [_of_package(shelf, name) for name in names_of_lock() if name != BUILD_ONLY]


def build_own(folder: Path, shelf: Path) -> Path:
    """Builds flockd's wheel into ``folder`` with the locked setuptools of ``shelf``. Raises CalledProcessError.

    The tree is copied first: setuptools takes into a wheel whatever an earlier build left in `build/`.
    """
    with tempfile.TemporaryDirectory() as scratch:
        source, tools = Path(scratch) / "source", Path(scratch) / "tools"
        source.mkdir()
        copy_sources(source)
        unpack(_of_package(shelf, BUILD_ONLY), tools)
        options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", f"--wheel-dir={folder}"]
        _pip("wheel", *options, str(source), PYTHONPATH=str(tools))
    return _of_package(folder, "flockd")


def unpack(wheel: Path, target: Path) -> None:
    """Lays a wheel's files where `site-packages` has them. Raises ValueError for a wheel that wants files elsewhere."""
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if name.split("/")[0].endswith(".data"):
                raise ValueError(f"{wheel.name} installs {name} outside site-packages, which is not supported")
        archive.extractall(target)


def _of_package(shelf: Path, name: str) -> Path:
    return next(shelf.glob(f"{name.replace('-', '_')}-*.whl"))


def _pip(*arguments: str, **environment: str) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    subprocess.run(command, check=True, env={**os.environ, **environment})

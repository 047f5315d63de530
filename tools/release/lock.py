"""Write requirements/service.txt: every package that the service is installed from, with its version and hashes.

python -m tools.release.lock

The packages are the run-time dependencies of pyproject.toml, what they need, and what builds flockd itself, for Linux
on x86-64 and ARM64 and for Python 3.11 to 3.13. Only wheels: the code of a source package would run while it is
installed. Versions are the newest that pyproject.toml permits and that all these have, so that a call is also how they
are renewed. Needs `uv` (the extra `release`) and a package index.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LOCK = ROOT / "requirements" / "service.txt"
HEADER = """\
# What the service is installed from, on Linux, x86-64 and ARM64, with Python 3.11 to 3.13. Written by
# `python -m tools.release.lock`; do not edit. Install it with
# pip install --require-hashes -r requirements/service.txt
"""
OLDEST_PYTHON = "3.11"
SYSTEMS = ("x86_64-unknown-linux-gnu", "aarch64-unknown-linux-gnu")
PYTHONS = ("3.11", "3.12", "3.13")


@dataclass(frozen=True)
class Pin:
    """One line of the lock."""

    name: str
    """As package indexes write it: lower case, with `-`."""
    version: str
    marker: str
    """Where it is for, such as `python_full_version < '3.12'`; empty: everywhere."""
    hashes: tuple[str, ...]
    """SHA-256 of each file that may be installed."""


def inputs() -> list[str]:
    """The requirements of pyproject.toml that the lock is made from."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return [*project["project"]["dependencies"], *project["build-system"]["requires"]]


def pins(text: str) -> list[Pin]:
    """The packages of a lock. Raises ValueError for a line that names no exact version."""
    found = []
    for entry in text.replace("\\\n", " ").splitlines():
        line = entry.partition("#")[0].strip()
        if not line or line.startswith("--only-binary"):
            continue
        matched = re.fullmatch(r"([a-z0-9-]+)==([^\s;]+)(?:\s*;\s*(.*?))?((?:\s+--hash=sha256:[0-9a-f]{64})+)", line)
        if matched is None:
            raise ValueError(f"{line[:60]!r} is not `name==version` with hashes; write the lock again")
        name, version, marker, hashes = matched.groups()
        found.append(Pin(name, version, marker or "", tuple(re.findall(r"sha256:(\w+)", hashes))))
    return found


def compiled(uv: str, *options: str) -> str:
    """What uv resolves the inputs to. Raises CalledProcessError."""
    with tempfile.TemporaryDirectory() as folder:
        wanted = Path(folder) / "wanted.in"
        wanted.write_text("\n".join(inputs()) + "\n", encoding="utf-8")
        command = [uv, "pip", "compile", "--quiet", "--no-header", "--no-annotate", "--only-binary=:all:", *options]
        return subprocess.run([*command, str(wanted)], check=True, stdout=subprocess.PIPE, text=True).stdout


def _check_each_system(uv: str, lock: str) -> None:
    """Raises CalledProcessError where a system has no wheel of a locked version."""
    with tempfile.TemporaryDirectory() as folder:
        locked = Path(folder) / "locked.txt"
        locked.write_text(lock, encoding="utf-8")
        for system in SYSTEMS:
            for python in PYTHONS:
                where = (f"--python-platform={system}", f"--python-version={python}")
                compiled(uv, f"--constraint={locked}", *where)


def main() -> int:
    """Command line."""
    uv = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if uv is None:
        print("lock: uv is not installed; `pip install '.[release]'`", file=sys.stderr)
        return 69
    options = ("--universal", "--fork-strategy=fewest", f"--python-version={OLDEST_PYTHON}")
    try:
        text = compiled(uv, *options, "--generate-hashes", "--emit-build-options")
        _check_each_system(uv, text)
    except subprocess.CalledProcessError:
        return 1
    LOCK.parent.mkdir(exist_ok=True)
    LOCK.write_text(f"{HEADER}{text}", encoding="utf-8")
    print(f"{LOCK.relative_to(ROOT)}: {len(pins(text))} packages")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Runs pytest in a process of its own with the hooks of `tests/conftest.py`, to test those."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def pytest_with_our_hooks(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """The tests of a folder; ids are relative to it."""
    isolated = ["-c", "/dev/null", "--rootdir", str(folder), "-p", "tests.conftest"]
    command = [sys.executable, "-m", "pytest", "-q", *isolated, *options, str(folder)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)

"""Runs pytest in a process of its own with the hooks of `tests/conftest.py`, to test those."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def pytest_with_our_hooks(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """The tests of a folder; ids are relative to it."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.conftest", "--rootdir", str(folder), "-c", "/dev/null"]
    return subprocess.run(
        [*command, *options, str(folder)], cwd=ROOT, capture_output=True, text=True, check=False, timeout=120
    )

"""What several tests of networks begin with."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from flockd.core.data import data_path


@pytest.fixture
def copies(tmp_path: Path) -> Path:
    """The shipped models, to be damaged."""
    folder = tmp_path / "models"
    shutil.copytree(data_path("models"), folder)
    return folder

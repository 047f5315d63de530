"""What several tests of perception begin with."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from flockd.data import data_path


@pytest.fixture
def copies(tmp_path: Path) -> Path:
    """The shipped models, to be spoilt."""
    folder = tmp_path / "models"
    shutil.copytree(data_path("models"), folder)
    return folder

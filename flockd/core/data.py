"""Finds the files that come with flockd: ready-made configurations, model files and systemd units."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from flockd.core.errors import UnavailableError


def data_path(folder: Literal["config", "models", "systemd"]) -> Path:
    """The folder of that name: inside an installed package, beside the package in a checkout.

    Raises UnavailableError when it is in neither.
    """
    package = Path(__file__).parents[1]
    for candidate in (package / "_data" / folder, package.parent / folder):
        if candidate.is_dir():
            return candidate
    raise UnavailableError(f"the folder {folder} that comes with flockd is not there; install flockd again")

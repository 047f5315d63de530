"""Paths of the files that come with flockd, and atomic writing of a file."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from flockd.core.errors import UnavailableError

LFS_POINTER = b"version https://git-lfs.github.com/spec/"
"""What stands in a file's place where Git LFS has not fetched it."""


def data_path(folder: Literal["config", "models", "systemd"]) -> Path:
    """The folder of that name, inside an installed package or beside the package in a checkout.

    Raises UnavailableError if it is in neither.
    """
    package = Path(__file__).parents[1]
    for candidate in (package / "_data" / folder, package.parent / folder):
        if candidate.is_dir():
            return candidate
    raise UnavailableError(f"the folder {folder} that comes with flockd is not there; install flockd again")


@contextmanager
def written_whole(target: Path) -> Iterator[Path]:
    """A temporary path to write to. It is renamed to the target at the end, and deleted after an error.

    Its name ends like the target's, because writers choose a format by it. If no file was written, the target stays.
    """
    draft = target.with_name(f".{target.stem}.{uuid.uuid4().hex[:8]}.part{target.suffix}")
    try:
        yield draft
        if draft.exists():
            draft.replace(target)
    finally:
        draft.unlink(missing_ok=True)

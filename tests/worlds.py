"""Worlds of the simulator, each generated once in a run of the tests: one takes a core 5 s, and nothing changes it."""

from __future__ import annotations

import fcntl
import hashlib
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

FOLDER = "FLOCKD_TEST_WORLDS"
"""The variable that names the folder to the workers of a run, which share their worlds."""
KEPT = 3
"""How many a worker keeps in memory, of 80 MB each."""


def share_worlds(config: pytest.Config) -> None:
    """Makes the folder, for as long as the run takes."""
    if FOLDER not in os.environ:
        folder, patch = TemporaryDirectory(prefix="flockd-worlds-"), pytest.MonkeyPatch()
        patch.setenv(FOLDER, folder.name)
        config.add_cleanup(patch.undo)
        config.add_cleanup(folder.cleanup)


@pytest.fixture(scope="session", autouse=True)
def generate_anew() -> Iterator[Callable[..., Any] | None]:
    """As the simulator does, where a test has imported it. All others get what has been generated with these arguments:
    `tests/sim/renderer/test_renderer.py` holds one against the other."""
    if (module := sys.modules.get("flockd.sim.world.world")) is None:
        yield None
        return
    anew = module.World.generate

    @lru_cache(KEPT)
    def generated(arguments: bytes) -> Any:
        file = Path(os.environ[FOLDER]) / hashlib.sha256(arguments).hexdigest()
        with file.open("a+b") as kept:
            fcntl.flock(kept, fcntl.LOCK_EX)  # another worker may be at it
            if file.stat().st_size == 0:
                places, names = pickle.loads(arguments)
                pickle.dump(anew(*places, **names), kept)
            kept.seek(0)
            return pickle.load(kept)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module.World, "generate", lambda *places, **names: generated(pickle.dumps((places, names))))
        yield anew

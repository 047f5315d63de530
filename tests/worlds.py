"""Worlds of the simulator, each generated once: a test that flies in one would otherwise wait seconds for it."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from functools import lru_cache

import pytest

from flockd.sim.world.world import World

generate_anew = World.generate
KEPT = 3
"""How many are kept, of 80 MB each."""


@pytest.fixture(scope="session", autouse=True)
def worlds_once() -> Iterator[None]:
    """The same arguments give the same world, which nothing changes: see `tests/sim/renderer/test_renderer.py`."""

    @lru_cache(KEPT)
    def generated(arguments: bytes) -> World:
        places, names = pickle.loads(arguments)
        return generate_anew(*places, **names)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(World, "generate", lambda *places, **names: generated(pickle.dumps((places, names))))
        yield

"""Pictures for all pages: each camera is asked once a second at most, and no request waits for a drone for long."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

EVERY_S = 1.0
SHOWN_S = 5.0
"""So old a picture may be that is shown while the next one is on its way."""
WAIT_S = 0.25
"""For a picture that comes at once; a later one is there for the next request."""
SILENT_S = 5.0
"""A camera of which no picture came is asked again after this."""
_THREADS, _THREADS_A_DRONE = 16, 4
_MOST_KEPT = 500

Key = tuple[str, str]
"""A drone and a camera."""


class PagePictures:
    """On the event loop; what waits for drones has threads of its own, of which one drone has a few."""

    def __init__(self, fetch: Callable[[str, str], bytes | None], clock: Callable[[], float] = time.monotonic) -> None:
        """``fetch``: of a drone and a camera; waits."""
        self._fetch, self._clock = fetch, clock
        self._threads = ThreadPoolExecutor(_THREADS, "pictures for the fleet page")
        self._asking: dict[Key, asyncio.Task[None]] = {}
        self._made: dict[Key, tuple[float, bytes | None]] = {}

    async def newest(self, drone: str, camera: str) -> bytes | None:
        """A live one; None where there is none yet, or none any more."""
        key, now_s = (drone, camera), self._clock()
        made_s, picture = self._made.get(key, (-SILENT_S, None))
        asking = self._asking.get(key)
        if asking is None and now_s - made_s >= (EVERY_S if picture is not None else SILENT_S):
            of_drone = sum(one == drone for one, _ in self._asking)
            if len(self._asking) < _THREADS and of_drone < _THREADS_A_DRONE:
                asking = self._asking[key] = asyncio.create_task(self._ask(key))
        if asking is not None:
            await asyncio.wait({asking}, timeout=WAIT_S)
            made_s, picture = self._made.get(key, (-SILENT_S, None))
        return picture if self._clock() - made_s < SHOWN_S else None

    async def _ask(self, key: Key) -> None:
        try:
            picture = await asyncio.get_running_loop().run_in_executor(self._threads, self._fetch, *key)
            self._made.pop(key, None)
            self._made[key] = self._clock(), picture
            while len(self._made) > _MOST_KEPT:
                self._made.pop(next(iter(self._made)))
        finally:
            del self._asking[key]

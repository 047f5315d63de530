"""Waits for things that take as long as an emulated processor needs."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 180.0
LOOK_S = 0.1


def until(condition: Callable[[], bool], what: str, *, look_s: float = LOOK_S, within_s: float = PATIENCE_S) -> float:
    """When it became so, on the monotonic clock. Raises TimeoutError, which names what was waited for."""
    begun_s = time.monotonic()
    while not condition():
        if time.monotonic() - begun_s > within_s:
            raise TimeoutError(f"waited {within_s:g} s for {what}")
        time.sleep(look_s)
    return time.monotonic()

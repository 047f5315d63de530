"""A deadline for work that another thread can end: a network's first run, mostly."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait

GOLDEN_S = 8.0
"""For a network's run on its golden input, which takes less than a second on any computer that flies: a network that
never ends is refused within ten."""
_END_S = 1.0
"""How long work may take to end when it is stopped; ONNX Runtime takes a few milliseconds."""


def within(seconds: float) -> Callable[[Callable[[], None], Callable[[], None]], None]:
    """Something that runs its first argument, and where that takes longer stops it by the second.

    It then raises TimeoutError, whether or not the work has ended; what the work itself raises passes through.
    """

    def run(work: Callable[[], None], stop: Callable[[], None]) -> None:
        done: Future[None] = Future()

        def body() -> None:
            try:
                work()
            except BaseException as error:  # noqa: BLE001 - raised again in the thread that waits
                done.set_exception(error)
            else:
                done.set_result(None)

        threading.Thread(target=body, name="deadline", daemon=True).start()
        if not wait([done], seconds).done:
            stop()
            wait([done], _END_S)
            raise TimeoutError(f"more than {seconds:g} s")
        done.result()

    return run

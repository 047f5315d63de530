"""Fakes of cameras that film."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from tests.onboard.sources.camera_images import jpeg, scene
from tests.onboard.sources.fake_kernel import FakeKernel

RATE_HZ = 30.0
JPEGS = [jpeg(scene(number)) for number in range(4)]


@contextmanager
def filming(
    kernel: FakeKernel,
    *names: str,
    beats_s: Callable[[int], float] = lambda number: number / RATE_HZ,
    pictures: Sequence[bytes] = JPEGS,
    lost: Callable[[int], int] = lambda number: 0,
    flags: Callable[[int], int] | None = None,
    old_s: float = 0.0,
) -> Iterator[None]:
    """Each camera takes picture n at its time stamp, as soon as it streams; a busy computer delays the hand-over."""
    ended = threading.Event()

    def film(name: str) -> None:
        begun_s, number = time.monotonic(), 0
        while not ended.is_set():
            stamp = begun_s + beats_s(number)
            if stamp > time.monotonic():
                ended.wait(stamp - time.monotonic())
            elif kernel.cameras[f"/dev/{name}"].streaming:
                more = {} if flags is None else {"flags": flags(number)}
                try:
                    kernel.send(
                        name,
                        pictures[number % len(pictures)],
                        time_s=stamp - old_s,
                        lost_before=lost(number),
                        wait_s=0.5,
                        **more,
                    )
                except AssertionError:  # nobody takes it any more
                    return
                number += 1
            else:
                begun_s = time.monotonic() - beats_s(number)
                time.sleep(0.005)

    threads = [threading.Thread(target=film, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()

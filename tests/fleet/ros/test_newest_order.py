"""A drone that does not answer holds up nobody's orders."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

from flockd.fleet.ros.newest_order import NewestOrder
from tests.fleet.ros.peers import until


def test_of_orders_that_wait_the_newest_counts() -> None:
    taken: list[int] = []
    answered, over = threading.Event(), threading.Event()

    def take(order: int) -> None:
        taken.append(order)
        if order == 1:
            answered.wait(60.0)
        if order == 50:
            over.set()

    with ThreadPoolExecutor(2) as threads:
        slow, other = NewestOrder(threads, take), NewestOrder(threads, lambda order: taken.append(-order))
        slow.offer(1)
        until(lambda: taken == [1])
        for order in range(2, 51):
            slow.offer(order)  # returns at once, though the drone is silent
        other.offer(1)
        until(lambda: -1 in taken)
        answered.set()
        assert over.wait(60.0)
        slow.offer(51)
        until(lambda: 51 in taken)
    assert taken == [1, -1, 50, 51]

"""Puts the autopilot's EVENT messages in order, and says which are missing; pure, knows no clock.

MAVLink's events protocol numbers events, and sends those again that are requested while the autopilot has them still.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

Fields = Mapping[str, Any]
NUMBERS = 1 << 16
MOST_MISSING = 20
"""PX4 keeps so many events."""
ASK_AGAIN_S, MOST_REQUESTS = 0.3, 3


class EventOrder:
    """Hands out events by their numbers; one that is missing holds the others up until it comes or is given up."""

    def __init__(self) -> None:
        self._next: int | None = None
        self._last = 0
        """The newest number that the autopilot has used."""
        self._waiting: dict[int, Fields] = {}
        self._asked_s, self._requests = -math.inf, 0
        self.gaps = 0
        """How often events were given up."""

    def add(self, fields: Fields) -> list[Fields]:
        """Takes an EVENT; those that follow without a gap now, in order. One without a number is ignored."""
        try:
            number = int(fields["sequence"]) % NUMBERS
        except (KeyError, TypeError, ValueError, OverflowError):
            return []
        if self._next is None:
            self._next = self._last = number
        if self._ahead(number) < 0:
            return []  # it came already
        self._waiting[number] = fields
        self._last = max(self._last, number, key=self._ahead)
        if self._ahead(number) > MOST_MISSING:
            self._skip()
        return self._follow()

    def announce(self, number: int, *, reset: bool) -> None:
        """The autopilot says that this is the number of its newest event; ``reset``: it counts anew."""
        if reset or self._next is None or abs(self._ahead(number)) > MOST_MISSING:
            self._next, self._last, self._waiting = (number + 1) % NUMBERS, number, {}
        self._last = max(self._last, number, key=self._ahead)

    def missing(self, now_s: float) -> tuple[int, int] | None:
        """The first and the last number to request now; None: none is missing, or it is too early to ask again."""
        if self._next is None or self._ahead(self._last) < 0 or now_s - self._asked_s < ASK_AGAIN_S:
            return None
        self._asked_s, self._requests = now_s, self._requests + 1
        first = last = self._next
        while last != self._last and (last + 1) % NUMBERS not in self._waiting:
            last = (last + 1) % NUMBERS
        return first, last

    def give_up(self) -> list[Fields]:
        """The events after those that were requested in vain."""
        if self._requests <= MOST_REQUESTS:
            return []
        self._skip()
        return self._follow()

    def _ahead(self, number: int) -> int:
        """Of the number that comes next; negative: before it. Numbers begin again after the last."""
        assert self._next is not None
        half = NUMBERS // 2
        return (number - self._next + half) % NUMBERS - half

    def _skip(self) -> None:
        self.gaps += 1
        self._next = min(self._waiting, key=self._ahead, default=(self._last + 1) % NUMBERS)
        self._requests = 0

    def _follow(self) -> list[Fields]:
        ready = []
        while self._next in self._waiting:
            ready.append(self._waiting.pop(self._next))
            self._next, self._requests = (self._next + 1) % NUMBERS, 0
        return ready

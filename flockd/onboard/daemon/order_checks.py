"""Whether an operator's order is for this drone, new and in time: each counts once, and the later one wins."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from flockd.core import services
from flockd.onboard.telemetry.topics import AskMessage

LATEST_S = services.ORDER.timeout
"""Older than this an order may surprise whoever gave it. A sender asks for the drone's clock just before."""
AHEAD_S = 0.5
"""No order comes from later than now; its sender's own clock runs on while the two are on their way."""
MOST_SESSIONS = 1000
SAFE = frozenset({"hold", "land"})
"""Taken although another operator's later order has come before: they end a flight."""
RECENT_S, MOST_RECENT = 60.0, 8


@dataclass(frozen=True)
class TakenOrder:
    """An order that was taken, and when on the drone's clock."""

    operator: str
    command: str
    sequence: int
    taken_s: float


class OrderChecks:
    """Takes orders on any thread."""

    def __init__(self, identity: str, clock: Callable[[], float]) -> None:
        """``identity``: the drone's; ``clock``: the one that it tells its watchers."""
        self._identity, self._clock = identity, clock
        self._lock = threading.Lock()
        self._sequences: OrderedDict[str, int] = OrderedDict()
        self._newest: tuple[float, TakenOrder] | None = None
        self._recent: dict[str, TakenOrder] = {}

    def fault(self, command: str, ask: AskMessage) -> str | None:
        """Why an order is refused, for its sender; None: it is not. Its number counts as used from now on."""
        if ask["identity"] != self._identity:
            return f"it is for another drone of this name, with the identity {ask['identity']!r:.20}"
        age_s = self._clock() - ask["time_s"]
        if not -AHEAD_S <= age_s <= LATEST_S:
            early = f"is from {age_s:.1f} s ago" if age_s > 0 else f"is from {-age_s:.1f} s ahead of the drone's clock"
            return f"it {early}; an order counts for {LATEST_S:g} s; give it again"
        with self._lock:
            if ask["sequence"] <= self._sequences.get(ask["session"], -1):
                return f"order {ask['sequence']} or a later one of this sender has come before"
            self._sequences[ask["session"]] = ask["sequence"]
            self._sequences.move_to_end(ask["session"])
            while len(self._sequences) > MOST_SESSIONS:
                self._sequences.popitem(last=False)
            if self._newest is not None and ask["time_s"] < self._newest[0] and command not in SAFE:
                later = self._newest[1]
                return f"{later.operator} gave a later order, {later.command}, that has come before"
        return None

    def take(self, command: str, ask: AskMessage) -> None:
        """An order is carried out."""
        taken = TakenOrder(ask["operator"], command, ask["sequence"], self._clock())
        with self._lock:
            if self._newest is None or ask["time_s"] >= self._newest[0]:
                self._newest = ask["time_s"], taken
            self._recent = {name: one for name, one in self._recent.items() if name != taken.operator}
            self._recent[taken.operator] = taken
            while len(self._recent) > MOST_RECENT:
                self._recent.pop(next(iter(self._recent)))

    def recent(self) -> tuple[TakenOrder, ...]:
        """The last of each operator within `RECENT_S`, the newest first."""
        now_s = self._clock()
        with self._lock:
            return tuple(one for one in reversed(self._recent.values()) if now_s - one.taken_s <= RECENT_S)

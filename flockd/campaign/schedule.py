"""Which flights are to be flown next, such that it does not depend on which flight is done first."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from flockd.campaign.campaign_file import StopRule
from flockd.campaign.figures import MEASURES
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.intervals import mean_interval


class Schedule:
    """Without a stop rule all flights; with one a batch of a cell's seeds, and the next once all of these are done."""

    def __init__(self, plan: Plan) -> None:
        self._seeds, self._stop = plan.config.seeds, plan.config.stop
        self._batch = self._seeds if self._stop is None else self._stop.batch
        self._values: dict[int, dict[int, float | None]] = {cell.number: {} for cell in plan.cells}
        """What the stop rule is about, for each cell by number of the seed."""
        self._until = dict.fromkeys(self._values, min(self._batch, self._seeds))
        """How many seeds of each cell are to be flown."""
        self._open = set(self._values)
        """Cells that may need more."""
        self._waiting: deque[tuple[int, int, int]] = deque()
        """Cells, each with its first and the end of the seeds that are to be flown."""
        for cell in self._values:
            self._add(cell, 0)

    def finished(self, runs: Iterable[tuple[Run, float | None]]) -> None:
        """Takes note of flights, each with its value of the stop rule's figure; None where it has none."""
        for run, value in runs:
            self._values[run.cell][run.number] = value
            self._decide(run.cell)

    def next(self, count: int) -> tuple[Run, ...]:
        """Up to ``count`` flights of one cell that are to be flown; empty where there are none now."""
        found: list[Run] = []
        while self._waiting and not found:
            cell, begin, end = self._waiting.popleft()
            number = begin
            while number < end and len(found) < count:
                if number not in self._values[cell]:
                    found.append(Run(cell, number))
                number += 1
            if number < end:
                self._waiting.appendleft((cell, number, end))
        return tuple(found)

    @property
    def most_left(self) -> int:
        """Flights that are not done, if no open cell is known well enough before its last seed."""
        needed = sum(self._seeds if cell in self._open else self._until[cell] for cell in self._values)
        return needed - sum(len(values) for values in self._values.values())

    def _decide(self, cell: int) -> None:
        """Once all flights so far are done: whether the cell needs more."""
        values = self._values[cell]
        while cell in self._open:
            begin = self._until[cell]
            if len(values) < begin or not all(number in values for number in range(begin)):
                return
            if begin == self._seeds or self._is_known(cell):
                self._open.remove(cell)
            else:
                self._until[cell] = min(begin + self._batch, self._seeds)
                self._add(cell, begin)

    def _add(self, cell: int, begin: int) -> None:
        self._waiting.append((cell, begin, self._until[cell]))

    def _is_known(self, cell: int) -> bool:
        return self._stop is not None and is_known(
            [self._values[cell][number] for number in range(self._until[cell])], self._stop
        )


def is_known(values: Iterable[float | None], stop: StopRule) -> bool:
    """Whether a cell with these values is known well enough."""
    known = [value for value in values if value is not None]
    interval = mean_interval(known, stop.confidence, is_share=MEASURES[stop.figure].is_share)
    return interval is not None and interval.half_width <= stop.half_width

"""The figures that a campaign measures of each flight, and the confidence interval of a mean."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError
from scipy.special import stdtrit

from flockd.core.messages import FloatArray
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.summary import estimation_errors, objective_sums, summarise, tail_of


class Interval(NamedTuple):
    """A mean with its 95 % confidence interval."""

    mean: float
    low: float
    high: float

    @property
    def half_width(self) -> float:
        """Half the width of the wider side."""
        return max(self.high - self.mean, self.mean - self.low)


_UPPER_END = 0.975
"""The quantile at the upper end of a 95 % interval, which leaves out 2.5 % on each side."""


def mean_interval(values: Sequence[float], *, is_share: bool = False) -> Interval | None:
    """The mean of values (n,) with its 95 % confidence interval: by Student's t, or, of values that are 0 or 1
    (``is_share``), by Wilson's score.

    None for fewer than two values; of 0 and 1 for none. E. B. Wilson, "Probable inference, the law of succession, and
    statistical inference", 1927.
    """
    n = len(values)
    if n < (1 if is_share else 2):
        return None
    mean = float(np.mean(values))
    if is_share:
        from scipy.stats import binomtest  # noqa: PLC0415 - heavy

        found = binomtest(int(sum(values)), n).proportion_ci(method="wilson")
        return Interval(mean, float(found.low), float(found.high))
    reach = float(stdtrit(n - 1, _UPPER_END)) * float(np.std(values, ddof=1)) / math.sqrt(n)
    return Interval(mean, mean - reach, mean + reach)


Figures = dict[str, float | None]


@dataclass(frozen=True)
class Measure:
    """One figure: its name, its unit, and the direction in which it is better."""

    name: str
    unit: str
    better: Literal["higher", "lower"]
    of: str | Callable[[FlightLog, dict[str, Any]], Any]
    """Its keys in a flight's summary, or a function of log and summary."""
    is_share: bool = False
    """The figure is 0 or 1 for one flight, so that its mean is a share of flights."""
    lowest: float = 0.0
    highest: float = math.inf
    """What the figure can be: no interval that is drawn goes beyond."""


def _nearest_at_the_end(log: FlightLog, _: dict[str, Any]) -> float:
    places = log.position[tail_of(log)][:, :, None, :2]
    apart = np.linalg.norm(places - places.swapaxes(1, 2), axis=-1)
    return float(np.where(apart > 0, apart, np.inf).min(axis=2).mean())


def _tail_mean(name: str) -> Callable[[FlightLog, dict[str, Any]], float]:
    def mean(log: FlightLog, _: dict[str, Any]) -> float:
        sums = objective_sums(log, log.position, log.velocity)[name]
        return float(np.mean(sums[tail_of(log)]))

    return mean


def _distance_error(percentile: float) -> Callable[[FlightLog, dict[str, Any]], float]:
    def error(log: FlightLog, _: dict[str, Any]) -> float:
        errors: FloatArray = np.abs(estimation_errors(log)["distance_m"])
        known = errors[np.isfinite(errors)]
        return float(np.percentile(known, percentile)) if log.metadata.by_sight and len(known) else math.nan

    return error


def _of_tracks(figure: str) -> Callable[[FlightLog, dict[str, Any]], Any]:
    return lambda _, summary: (summary["neighbours"]["associated_error_m"] or {}).get(figure)


def _convergence_time(log: FlightLog, summary: dict[str, Any]) -> float | None:
    """Of obj2; None where it never stays, or the flight ends too early to tell."""
    time_s: float | None = summary["table3"]["vision" if log.metadata.by_sight else "truth"]["obj2"]["time_s"]
    return time_s


MEASURES: dict[str, Measure] = {
    "min_distance_m": Measure("nearest distance", "m", "higher", "flock.min_distance_m"),
    "min_distance_after_10s_m": Measure("nearest distance after 10 s", "m", "higher", "flock.min_distance_after_10s_m"),
    "order_tail": Measure("order at the end", "", "higher", "flock.order_tail", lowest=-1.0, highest=1.0),
    "union_tail": Measure("union at the end", "", "higher", "flock.union_tail", highest=1.0),
    "safety": Measure("pairs 1 m apart or more", "of 1", "higher", "flock.safety", highest=1.0),
    "velocity_deviation_tail": Measure(
        "velocity deviation at the end, Σ obj1", "", "lower", _tail_mean("obj1"), lowest=-math.inf
    ),
    "shape_deviation_tail": Measure("shape deviation at the end, Σ obj2", "", "lower", _tail_mean("obj2")),
    "arrived": Measure("arrived", "of the flights", "higher", "mission.arrived", is_share=True, highest=1.0),
    "arrival_time_s": Measure("time of arrival", "s", "lower", "mission.time_s"),
    "final_error_m": Measure("distance from the goal at the end", "m", "lower", "mission.final_error_m"),
    "collisions": Measure("collisions with obstacles", "", "lower", "obstacles.collisions"),
    "min_clearance_m": Measure("least clearance", "m", "higher", "obstacles.min_clearance_m", lowest=-math.inf),
    "time_within_1m_s": Measure("time within 1 m of obstacles", "s", "lower", "obstacles.time_within_1m_s"),
    "recall_within_10m": Measure(
        "neighbours known within 10 m", "", "higher", "neighbours.recall_within_10m", highest=1.0
    ),
    "false_per_drone_minute": Measure(
        "false neighbours a drone and minute", "", "lower", "neighbours.false_per_drone_minute"
    ),
    "distance_error_median_m": Measure("distance error, median", "m", "lower", _distance_error(50.0)),
    "distance_error_p95_m": Measure("distance error, 95th percentile", "m", "lower", _distance_error(95.0)),
    "false_share": Measure("time with a false neighbour", "of 1", "lower", "neighbours.false_share", highest=1.0),
    "associated_error_median_m": Measure("error of all tracks, median", "m", "lower", _of_tracks("median")),
    "associated_error_p95_m": Measure("error of all tracks, 95th percentile", "m", "lower", _of_tracks("p95")),
    "associated_error_max_m": Measure("error of all tracks, largest", "m", "lower", _of_tracks("max")),
    "convergence_time_s": Measure("time from which the shape stays", "s", "lower", _convergence_time),
    "mean_nearest_tail_m": Measure("mean level distance to the nearest at the end", "m", "higher", _nearest_at_the_end),
    "drones_held": Measure("drones in Hold", "", "lower", "handed_over.drones"),
    "first_hold_s": Measure("time of the first Hold", "s", "higher", "handed_over.first_s"),
    "min_distance_flown_m": Measure(
        "nearest distance while flockd flew", "m", "higher", "handed_over.min_distance_flown_m"
    ),
    "collisions_flown": Measure(
        "collisions with obstacles while flockd flew", "", "lower", "handed_over.collisions_flown"
    ),
    "slowed_share": Measure("time slowed by gates", "of 1", "lower", "slowed_share", highest=1.0),
}


def _known(figure: str) -> str:
    if figure not in MEASURES:
        raise PydanticCustomError("unknown_figure", "is not a figure")
    return figure


Figure = Annotated[str, AfterValidator(_known), Field(json_schema_extra={"enum": list(MEASURES)})]
"""The name of one of `MEASURES`."""


def figures_of(log: FlightLog, wanted: Iterable[Figure]) -> Figures:
    """The wanted figures of a flight; None where this kind of flight has no such figure, or it is not finite."""
    summary = summarise(log)
    return {figure: _value(MEASURES[figure].of, log, summary) for figure in wanted}


def _value(of: str | Callable[[FlightLog, dict[str, Any]], Any], log: FlightLog, summary: Any) -> float | None:
    value = reduce(getitem, of.split("."), summary) if isinstance(of, str) else of(log, summary)
    return None if value is None or not math.isfinite(value) else float(value)

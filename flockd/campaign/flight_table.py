"""The results as tables: one row a flight, with the same columns in every file of a campaign.

`flights.parquet` holds what is the same whatever flew it: engine, number of workers, order. When and where a flight was
flown, and how long that took, is in `timings.parquet`. Both have the column `run`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from flockd import __version__
from flockd.campaign.flight_kinds import FlownRun
from flockd.campaign.flight_plan import CASE, Plan, values_of
from flockd.core.errors import UnavailableError

_TIMINGS: dict[str, Any] = {
    "wall_s": pa.float64(),
    "cpu_s": pa.float64(),
    "began": pa.string(),
    "host": pa.string(),
    "process": pa.int64(),
}
"""Columns that differ from one time to the next."""
_KEYS: dict[str, Any] = {"run": pa.string(), "cell": pa.int64(), "number": pa.int64(), "seed": pa.int64()}
_RESULT: dict[str, Any] = {"status": pa.string(), "reason": pa.string()}
_ORIGIN: dict[str, Any] = {
    "perception": pa.string(),
    "flockd_version": pa.string(),
    "numpy_version": pa.string(),
    "campaign_sha256": pa.string(),
    "scenario_sha256": pa.string(),
    "networks_sha256": pa.string(),
}


class FlightTable:
    """The rows of one campaign."""

    def __init__(self, plan: Plan) -> None:
        self._plan, self._sha256 = plan, plan.sha256
        self.parameters = _types_of_parameters(plan)
        """Columns of what varies, with their types."""
        fields = {**_KEYS, **self.parameters, **_RESULT, **dict.fromkeys(plan.wanted, pa.float64()), **_ORIGIN}
        self.schema = pa.schema(list({**fields, **_TIMINGS}.items()))
        self.flights_schema = pa.schema(list(fields.items()))
        self.timings_schema = pa.schema(list({**_KEYS, **_TIMINGS}.items()))

    def rows(self, flown: Sequence[FlownRun]) -> pa.Table:
        """A table of these flights."""
        return pa.Table.from_pylist([self._row(one) for one in flown], schema=self.schema)

    def merged(self, tables: Sequence[pa.Table]) -> pa.Table:
        """All rows in order of cells and seeds; of several of one flight the first."""
        whole = pa.concat_tables([self.schema.empty_table(), *tables])
        whole = whole.append_column("_place", pa.array(np.arange(len(whole))))
        order = [("cell", "ascending"), ("number", "ascending"), ("_place", "ascending")]
        whole = whole.sort_by(order).drop_columns(["_place"])
        keys = np.stack([whole["cell"].to_numpy(), whole["number"].to_numpy()], axis=1)
        first = np.ones(len(keys), dtype=bool)
        first[1:] = (keys[1:] != keys[:-1]).any(axis=1)
        return whole.filter(pa.array(first)).combine_chunks()

    def flights(self, whole: pa.Table) -> pa.Table:
        """The columns of `flights.parquet`."""
        return whole.select(self.flights_schema.names)

    def timings(self, whole: pa.Table) -> pa.Table:
        """The columns of `timings.parquet`."""
        return whole.select(self.timings_schema.names)

    def joined(self, flights: pa.Table, timings: pa.Table) -> pa.Table:
        """The whole table from both files, whose rows are in the same order."""
        return pa.table({**_columns(timings), **_columns(flights)}).select(self.schema.names).cast(self.schema)

    def _row(self, flown: FlownRun) -> dict[str, Any]:
        plan, run = self._plan, flown.run
        parameters = plan.parameters(plan.cells[run.cell], run.number)
        return {
            "run": run.name,
            "cell": run.cell,
            "number": run.number,
            "seed": plan.config.seed + run.number,
            **{name: _as(value, self.parameters[name]) for name, value in parameters.items()},
            "status": "flown" if flown.reason is None else "failed",
            "reason": flown.reason,
            **{figure: flown.figures.get(figure) for figure in plan.wanted},
            "perception": plan.config.perception,
            "flockd_version": __version__,
            "numpy_version": np.__version__,
            "campaign_sha256": self._sha256,
            "scenario_sha256": flown.scenario_sha256,
            "networks_sha256": flown.networks,
            **{name: getattr(flown, name) for name in _TIMINGS},
        }


def write_table(table: pa.Table, path: Path) -> None:
    """Writes the file at once or not at all, whatever happens meanwhile."""
    temporary = path.with_name(f".{path.name}.part")
    with temporary.open("wb") as stream:
        pq.write_table(table, stream, compression="zstd")
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Until the names of its files are on the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_table(path: Path, schema: pa.Schema) -> pa.Table:
    """The table, whose columns are these. Raises UnavailableError for a file that cannot be read, or has others."""
    try:
        if path.exists() and not path.is_file():
            raise _unreadable(path, "it is not an ordinary file")
        table = pq.read_table(path, partitioning=None)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _unreadable(path, str(error).partition("\n")[0]) from error
    if set(table.column_names) != set(schema.names) or len(table.column_names) != len(schema.names):
        raise _unreadable(path, "it has other columns than this campaign's flights")
    try:
        return table.select(schema.names).cast(schema)
    except pa.ArrowException as error:
        raise _unreadable(path, str(error).partition("\n")[0]) from error


def _unreadable(path: Path, why: str) -> UnavailableError:
    return UnavailableError(f"{path}: cannot be read ({why}); delete it, and its flights are flown again")


def _columns(table: pa.Table) -> dict[str, Any]:
    return dict(zip(table.column_names, table.columns, strict=True))


def _types_of_parameters(plan: Plan) -> dict[str, Any]:
    """One type a column, by all values it can have: what has none of its own is written as JSON."""
    types = {CASE: pa.string()} if plan.config.cases else {}
    for key, variation in plan.config.vary.items():
        values = (variation.low,) if variation.is_drawn else values_of(variation)
        kinds = {type(value) for value in values}
        if kinds <= {int}:
            types[key] = pa.float64() if variation.is_drawn else pa.int64()
        elif kinds <= {int, float}:
            types[key] = pa.float64()
        else:
            types[key] = pa.bool_() if kinds == {bool} else pa.string()
    return types


def _as(value: Any, kind: Any) -> Any:
    """A parameter's value as its column has it."""
    if kind == pa.string():
        return value if isinstance(value, str) else json.dumps(value)
    return value

"""Drones sorted into square cells, so that each finds those near it without a look at all others. Compiled.

A flock's cells are rows to the north of cells to the east. Within a row they are one after the other in memory: all
drones of a row between two places to the east are one slice.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

CELLS_A_DRONE = 4
"""No more cells than that, or 16: a flock that has scattered gets larger ones."""
_DRONES_A_CELL = 2.0
_SMALLEST_CELL_M = 0.25


@njit(nogil=True, cache=True, error_model="numpy")
def sort_flights(first: int, last: int, states: Any, grids: Any, starts: Any, order: Any, by_slot: Any) -> None:
    """Sorts the drones of the flights from `first` to before `last`.

    `states` (6, flights, n): position and velocity, NED. Fills `grids` (flights, 5) with each flight's least north and
    east, cell size, rows and columns, `starts` (flights, cells + 1) with the first slot of each cell, `order` (flights,
    n) with the drone of each slot, and `by_slot` (6, flights, n) with the states in the order of the slots.
    """
    n = states.shape[2]
    for f in range(first, last):
        x = states[0, f]
        y = states[1, f]
        north = x.min()
        east = y.min()
        high = x.max() - north
        wide = y.max() - east
        most = starts.shape[1] - 1
        cell = max(math.sqrt(_DRONES_A_CELL * max(high * wide, 1e-12) / n), _SMALLEST_CELL_M)
        cell = max(cell, max(high, wide) / (most / 2 - 2.0))
        while (math.floor(high / cell) + 1) * (math.floor(wide / cell) + 1) > most:
            cell *= 1.25
        rows = math.floor(high / cell) + 1
        columns = math.floor(wide / cell) + 1
        grids[f, 0], grids[f, 1], grids[f, 2], grids[f, 3], grids[f, 4] = north, east, cell, rows, columns
        _sort(x, y, grids[f], starts[f], order[f])
        for part in range(6):
            for slot in range(n):
                by_slot[part, f, slot] = states[part, f, order[f, slot]]


@njit(nogil=True, cache=True, error_model="numpy")
def _sort(x: Any, y: Any, grid: Any, starts: Any, order: Any) -> None:
    """A counting sort: within a cell drones stay in their order."""
    rows = int(grid[3])
    columns = int(grid[4])
    starts[: rows * columns + 1] = 0
    for i in range(x.size):
        starts[cell_of(x[i], y[i], grid) + 1] += 1
    for c in range(rows * columns):
        starts[c + 1] += starts[c]
    for i in range(x.size):  # moves each start to the next cell's
        c = cell_of(x[i], y[i], grid)
        order[starts[c]] = i
        starts[c] += 1
    for c in range(rows * columns, 0, -1):
        starts[c] = starts[c - 1]
    starts[0] = 0


@njit(nogil=True, cache=True, error_model="numpy")
def row_of(x: float, grid: Any) -> int:
    """Row of a place to the north; the nearest row where it is beyond them."""
    return int(min(max(math.floor((x - grid[0]) / grid[2]), 0), grid[3] - 1))


@njit(nogil=True, cache=True, error_model="numpy")
def column_of(y: float, grid: Any) -> int:
    """Column of a place to the east; the nearest column where it is beyond them."""
    return int(min(max(math.floor((y - grid[1]) / grid[2]), 0), grid[4] - 1))


@njit(nogil=True, cache=True, error_model="numpy")
def cell_of(x: float, y: float, grid: Any) -> int:
    """The number of the cell at a place."""
    return row_of(x, grid) * int(grid[4]) + column_of(y, grid)


@njit(nogil=True, cache=True, error_model="numpy")
def slice_of_row(row: int, x: float, y: float, reach: float, grid: Any, starts: Any) -> Any:
    """First and last slot (one past it) of a row's drones that may be within `reach` of a place."""
    low = grid[0] + row * grid[2]
    away = max(low - x, x - (low + grid[2]), 0.0) * (1.0 - 1e-9)
    if away > reach and not (row == 0 or row == int(grid[3]) - 1):
        return 0, 0
    half = math.sqrt(max(reach * reach - away * away, 0.0)) * (1.0 + 1e-9) + 1e-9
    base = row * int(grid[4])
    return starts[base + column_of(y - half, grid)], starts[base + column_of(y + half, grid) + 1]

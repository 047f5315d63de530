"""Flies a campaign of the paper's scenario on exact states with one process and with two, and prints how fast each was.

    python -m tools.measure.bench_campaign                    # 40 flights each
    python -m tools.measure.bench_campaign --flights 1000 --workers 1 2 4

Efficiency is the speed with more processes over that with one. Where other programs run beside, wall time says little:
`cpu_s_a_flight` is processor time, which does not count what others take. `start_s` is until each worker has done a
flight, and not counted in the speed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from flockd.campaign.conduct import conduct
from flockd.campaign.engines import ENGINES, EngineName
from flockd.campaign.flight_plan import Plan
from flockd.campaign.folder import FLIGHTS_NAME, TIMINGS_NAME, CampaignFolder
from flockd.core.data import data_path


def main() -> None:
    """Prints a JSON object for each number of workers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument(
        "--duration", type=float, default=110.0, metavar="S", help="of each flight; the paper's is 110 s"
    )
    parser.add_argument("--engine", choices=sorted(ENGINES), default="processes")
    args = parser.parse_args()
    alone = None
    for workers in args.workers:
        found = measured(args.flights, workers, args.duration, args.engine)
        alone = found["flights_an_hour"] if alone is None else alone
        print(json.dumps({**found, "times_the_first": round(found["flights_an_hour"] / alone, 3)}), flush=True)


def measured(flights: int, workers: int, duration_s: float, engine: EngineName) -> dict[str, Any]:
    """How fast so many flights were flown."""
    told: list[float] = []

    def tell(done: int, _: int) -> None:
        told.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as name:
        plan = Plan.load(_file(Path(name), flights, duration_s))
        with CampaignFolder(Path(name) / "out", plan) as folder, ENGINES[engine](workers, None) as started:
            conduct(plan, folder, started, tell)
        rows = pq.read_table(Path(name) / "out" / FLIGHTS_NAME)
        timings = pq.read_table(Path(name) / "out" / TIMINGS_NAME)
    first, last = told[workers], told[-1]  # each worker has flown one, and is warm
    cpu_s = sum(timings["cpu_s"].to_pylist()) / flights
    return {
        "workers": workers,
        "flights": flights,
        "failed": rows["status"].to_pylist().count("failed"),
        "start_s": round(first - told[0], 2),
        "wall_s": round(last - told[0], 2),
        "flights_an_hour": round(3600 * (flights - workers) / (last - first)),
        "cpu_s_a_flight": round(cpu_s, 3),
        "flights_an_hour_a_core_by_cpu_time": round(3600 / cpu_s),
    }


def _file(folder: Path, flights: int, duration_s: float) -> Path:
    path = folder / "bench.yaml"
    path.write_text(
        f"campaign: bench\nscenario: {data_path('config') / 'paper_flight.yaml'}\nseeds: {flights}\nscatter_m: 0.5\n"
        f"fixed: {{duration_s: {duration_s}, vehicle.gust_m_s: 0.3}}\n",
        encoding="utf-8",
    )
    return path


if __name__ == "__main__":
    main()

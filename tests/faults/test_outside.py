"""Faults that come over the network, while a whole drone flies or is watched."""

from __future__ import annotations

import asyncio
import itertools
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh

from flockd.core.config import DroneConfig
from flockd.onboard.telemetry.zenoh_session import close_session, open_session
from flockd.sim.sitl.ports import free_endpoint
from tests.faults.process import Process, flying
from tests.make import changed
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import SECONDS_TO_FAIL, client
from tests.onboard.telemetry.test_hostile_peer import MAX_COST_MB, peak_mb
from tests.onboard.telemetry.test_malformed import FLIGHT

pytestmark = pytest.mark.slow
RUN = "from flockd.cli import program; program()"
ROOT = Path(__file__).parents[2]


async def _flies_on(process: Process) -> None:
    steps = process.heard()["computer"].message["steps"]
    await until(lambda: process.heard()["computer"].message["steps"] > steps + 4, SECONDS_TO_FAIL)
    assert process.fake_autopilot.mode == "OFFBOARD"
    assert process.program.ended is None


def _router(endpoint: str) -> tuple[Any, list[str]]:
    """What a drone connects to, and the keys of what it hears."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    session = zenoh.open(config)
    keys: list[str] = []
    session.declare_subscriber("flockd/v1/**", lambda sample: keys.append(str(sample.key_expr)))
    return session, keys


@pytest.mark.fault("telemetry-router-gone")
async def test_the_router_of_the_telemetry_goes_and_comes_back(tmp_path: Path) -> None:
    endpoint = free_endpoint()

    def through_a_router(config: DroneConfig) -> DroneConfig:
        return changed(config, telemetry__connect=(endpoint,))

    router, keys = _router(endpoint)
    async with flying(tmp_path, change=through_a_router) as process:
        await until(lambda: "flockd/v1/test/tiny/flight" in keys, SECONDS_TO_FAIL)
        gone_s = time.monotonic()
        router.close()
        await _flies_on(process)
        sent = [at_s for at_s, _ in list(process.fake_autopilot.setpoints) if at_s > gone_s]
        gaps = [after - before for before, after in itertools.pairwise(sent)]
        assert max(gaps) < 0.5, "PX4 wants two setpoints a second"
        router, keys = _router(endpoint)
        await until(lambda: "flockd/v1/test/tiny/flight" in keys, 60.0)
        router.close()


@pytest.mark.fault("malformed-telemetry")
async def test_nonsense_on_the_telemetry_bus(tmp_path: Path) -> None:
    """The drone reads nothing but questions; `hold` is not among `telemetry.commands` of this one."""
    async with flying(tmp_path) as process:
        session = zenoh.open(client(process.config.telemetry.listen[0]))
        key = "flockd/v1/test/tiny"
        for payload in (b"\xff\x00", b"[" * 10_000, b"", json.dumps({"time_s": "now"}).encode()):
            for topic in ("state", "flight", "ask/hold", "ask/land", "about", "alive", "image/front", "x/y/z"):
                session.put(f"{key}/{topic}", payload)
        for question in ("ask/hold", "ask/HOLD", "ask/land/now", "ask/*", "image/none", "image/" + "x" * 500):
            list(session.get(f"{key}/{question}", payload=b"\xff" * 1000, timeout=1.0))
        assert (await process.ask("ask/hold"))["accepted"] is False
        await _flies_on(process)
        assert not any("asked for land" in event for event in process.events)
        session.close()  # type: ignore[no-untyped-call]


@pytest.mark.fault("messages-of-any-size")
async def test_queries_of_any_size_and_number(tmp_path: Path) -> None:
    """Memory is that of the drone's whole process."""
    async with flying(tmp_path) as process:
        await _flies_on(process)
        session = zenoh.open(client(process.config.telemetry.listen[0]))
        before_mb = peak_mb(process.program.process.pid)
        for payload, count in ((bytes(200 << 20), 1), (bytes(60_000), 500)):
            for what in ("ask/hold", "image/front", "about", "time"):
                for _ in range(count):
                    session.get(
                        f"flockd/v1/test/tiny/{what}",
                        lambda _: None,
                        payload=payload,
                        congestion_control=zenoh.CongestionControl.BLOCK,
                    )
                    await asyncio.sleep(0.0)
        assert (await process.ask("ask/hold"))["accepted"] is False
        await _flies_on(process)
        assert peak_mb(process.program.process.pid) - before_mb < MAX_COST_MB
        session.close()  # type: ignore[no-untyped-call]


@pytest.mark.fault("wrong-types-of-a-peer")
def test_status_shows_a_peer_that_publishes_nonsense() -> None:
    """A real `flockd status`, piped and as JSON: it ends well, and nothing steers the terminal."""
    endpoint = free_endpoint()
    session = open_session("a test", [endpoint], [])
    texts = {"flight_mode": "\x1b[2J\x9b31m", "reasons": [{"event": "x", "sentence": "\x1b]0;owned\x07" + "y" * 5000}]}
    published = {
        "hostile/flight": {**FLIGHT, **texts, "height_m": 1e6},
        "wrong/flight": {**FLIGHT, "battery_share": "full", "reasons": None},
        "right/flight": FLIGHT,
        "right/neighbours": {"time_s": 1.0, "neighbours": {"confirmed": 3}},
    }
    tokens = [
        session.liveliness().declare_token(f"flockd/v1/f/{drone}/alive") for drone in ("hostile", "wrong", "right")
    ]

    def status(*options: str) -> str:
        command = [sys.executable, "-c", RUN, "status", "--connect", endpoint, "--seconds", "4", *options]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            while process.poll() is None:
                for key, message in published.items():
                    session.put(f"flockd/v1/f/{key}", json.dumps(message).encode())
                time.sleep(0.1)
            out, err = process.communicate()
        assert process.returncode == 0, err
        shown = out.decode("utf-8")
        assert not {c for c in shown if not c.isprintable()} - {"\n"}
        return shown

    table = status()
    assert "its message `flight` is malformed: reasons is no list" in table or "battery_share is no finite" in table
    assert "its message `neighbours` is malformed: neighbours is no list" in table
    assert all(len(line) < 1000 for line in table.splitlines())
    rows = {row["drone"]: row for row in json.loads(status("--json"))}
    assert rows["right"]["state"] == "normal"
    assert rows["wrong"]["state"] == "quiet"
    del tokens
    close_session(session)

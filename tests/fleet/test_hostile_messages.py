"""Telemetry, commands and controls of a simulation that nobody would send."""

from __future__ import annotations

import asyncio
import io
import json
import time
from random import Random
from types import SimpleNamespace
from typing import Any

import numpy as np
from rich.console import Console

from flockd.cli.status import _table
from flockd.core.data import data_path
from flockd.core.messages import MissionOrder
from flockd.fleet.drone_rows import drone_rows, history_row, status_rows
from flockd.fleet.simulation import CONTROLS, MAX_GUST_M_S, MAX_SPEED, MIN_SPEED, SimulationMessage
from flockd.fleet.watcher import FleetWatcher
from flockd.flight.safety import State
from flockd.onboard.daemon.operator_orders import OperatorCommands, OperatorRequests
from flockd.onboard.message_json import from_json
from flockd.onboard.telemetry.topics import TOPICS
from flockd.sim.flock.live_flight import LiveControls
from flockd.sim.scenario import load_scenario
from tests.hostile import ABSURD_TEXTS, absurd, assert_readable, hostile, mutated_bytes, mutated_json, nested
from tests.make import filled

COMMANDS = ("hold", "land", "goto", "velocity", "resume", "HOLD", "hold ", "hold/land", "__init__")
NAMES = ("drone1", "front", "\x1b[2J", "é", " ", "a" * 300)


def _sample(key: str, payload: bytes, attachment: bytes | None = None) -> Any:
    """What zenoh hands over, as far as flockd looks."""
    return SimpleNamespace(
        key_expr=key,
        payload=SimpleNamespace(to_bytes=lambda: payload, as_shm=lambda: payload),
        attachment=None if attachment is None else SimpleNamespace(to_bytes=lambda: attachment),
    )


def test_whatever_is_published_is_shown_or_left() -> None:
    examples = {name: filled(topic.type, 1.0) for name, topic in TOPICS.items()}
    now_s = [1000.0]

    @hostile(50)
    def check(random: Random) -> None:
        watcher._drones.clear()
        for _ in range(random.randrange(1, 12)):
            topic = random.choice(list(examples))
            message = mutated_json(random, examples[topic]) if random.random() < 0.9 else absurd(random)
            payload = json.dumps(message).encode("utf-8", "surrogatepass")
            if random.random() < 0.1:
                payload = random.choice((mutated_bytes(random, payload), nested(random), b"9" * 10_000))
            key = f"flockd/v1/{random.choice(NAMES)}/{random.choice(NAMES)}/{topic}"
            watcher._take_message(_sample(key, payload))
            now_s[0] += random.choice((0.0, 0.1))
        rows = status_rows(watcher.drones(), now_s[0] + random.choice((0.0, 1.0, 100.0)))
        json.dumps(rows, allow_nan=False)
        page = drone_rows(watcher.drones(), {}, now_s[0])
        history = [history_row(row, now_s[0]) for row in page.values()]
        json.dumps([page, history], allow_nan=False, ensure_ascii=False).encode()
        screen = io.StringIO()
        Console(file=screen, markup=False, highlight=False, width=1000).print(_table(rows))
        assert not {char for char in screen.getvalue() if char != "\n" and not char.isprintable()}

    with FleetWatcher(None, listen=(), connect=(), clock=lambda: now_s[0]) as watcher:  # connected to nobody
        check()


def test_a_changed_command_is_refused_or_carried_out_as_it_stands() -> None:
    loop = asyncio.new_event_loop()
    allowed = ("hold", "land", "goto", "velocity")
    orders = ({"north_m": 3.0, "east_m": 1.0, "speed_m_s": 1.0}, {"velocity_ne": [1.0, 0.5], "height_m": 4.0})
    ask = {"identity": "d", "operator": "a", "session": "s", "sequence": 1, "time_s": 7.0}
    seeds = [json.dumps({**ask, "order": order}).encode() for order in orders]

    @hostile(150)
    def check(random: Random) -> None:
        said: list[str] = []
        requests, orders_taken = OperatorRequests(), list[MissionOrder]()
        command = random.choice((*ABSURD_TEXTS, *NAMES, *COMMANDS, *allowed))
        if random.random() < 0.5:
            command = mutated_bytes(random, command.encode("utf-8", "replace")).decode("utf-8", "replace")
        payload = random.choice(seeds)
        if random.random() < 0.7:
            payload = mutated_bytes(random, payload)
        commands = OperatorCommands(
            allowed, requests, loop, said.append, order_fault=lambda order: None, fly=orders_taken.append,
            state=lambda: State.NORMAL, identity="d", clock=lambda: 8.0,
        )  # fmt: skip
        reply = commands.handle(command, payload)
        loop.call_soon(loop.stop)
        loop.run_forever()
        assert command in allowed or not reply["accepted"]
        assert len(orders_taken) == (reply["accepted"] and command in ("goto", "velocity"))
        for order in orders_taken:
            assert np.isfinite(np.hstack([value for value in vars(order).values() if value is not None])).all(), order
        taken = command if reply["accepted"] else ""
        assert (requests.hold, requests.land, requests.resume) == (taken == "hold", taken == "land", False)
        for sentence in (*said, reply["sentence"]):
            assert_readable(sentence)

    check()


def test_a_changed_control_of_a_simulation_is_refused_or_within_its_bounds() -> None:
    """Controls of a simulation that is flown live: refused, or values within their bounds."""
    scenario = load_scenario(data_path("config") / "paper_flight.yaml")
    values = (None, {"factor": 2.0}, {"gust_m_s": 0.5}, {"drone": "drone1", "camera": "front", "works": False})

    @hostile(150)
    def check(random: Random) -> None:
        controls = LiveControls(scenario, "s", by_sight=False)
        control, value = random.choice((*ABSURD_TEXTS, *CONTROLS)), random.choice(values)
        ask = {"identity": "s", "operator": "a", "session": "s", "sequence": 1, "time_s": int(time.monotonic())}
        payload = json.dumps({**ask, "order": mutated_json(random, value)}).encode()
        answer = controls.ask(control, mutated_bytes(random, payload) if random.random() < 0.5 else payload)
        assert_readable(answer["sentence"])
        assert control in CONTROLS or not answer["accepted"]
        state = controls.state()
        from_json(SimulationMessage, json.loads(json.dumps(state, allow_nan=False)))
        assert MIN_SPEED <= state["speed"] <= MAX_SPEED
        assert 0.0 <= state["gust_m_s"] <= MAX_GUST_M_S

    check()

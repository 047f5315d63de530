"""A real daemon takes goals and velocities from ROS 2, and refuses what it may not fly: run with `make ros`."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tests.fleet.ros.peers import Peer, bridge, own_domain, peer
from tests.onboard.autopilot.conftest import fake_autopilot, port
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import PATIENT, SECONDS_TO_FAIL, aboard

__all__ = ["fake_autopilot", "port"]
pytestmark = [pytest.mark.ros, pytest.mark.slow]

GOAL, TWIST = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped"
ALONE = PATIENT.model_copy(update={"alone_s": None})


async def answer_to(node: Peer, order: Callable[[], None]) -> dict[str, Any]:
    """What the drone said to an order by topic."""
    before = len(node.heard("/tiny/order_answer"))
    order()
    await until(lambda: len(node.heard("/tiny/order_answer")) > before, SECONDS_TO_FAIL)
    message: dict[str, Any] = node.heard("/tiny/order_answer")[before]["message"]
    return message


async def test_a_goal_is_flown_and_a_strangers_is_refused(
    tmp_path: Path, port: int, fake_autopilot: FakeAutopilot, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = own_domain()
    async with aboard(
        fake_autopilot, port, tmp_path, change=lambda config: config.model_copy(update={"safety": ALONE})
    ) as ship:
        connect = ("--connect", ship.config.telemetry.listen[0])
        with ExitStack() as stack:
            running = await asyncio.to_thread(stack.enter_context, bridge(environment, *connect, "--orders"))
            node = await asyncio.to_thread(stack.enter_context, peer(environment, "planner"))
            node.listen("/tiny/order_answer", "diagnostic_msgs/msg/DiagnosticStatus", "event")
            node.listen("/tiny/odometry", "nav_msgs/msg/Odometry")
            await ship.is_ready_in_the_air()
            await ship.flies()
            await until(lambda: bool(node.heard("/tiny/odometry")), SECONDS_TO_FAIL)
            await asyncio.sleep(2.0)  # the two ends of the answers' topic have found each other

            def send(frame: str, east: float, north: float, up: float) -> Callable[[], None]:
                place = {"pose.position.x": east, "pose.position.y": north, "pose.position.z": up}
                fields = {"header.frame_id": frame, **place}
                return lambda: node.do("publish", topic="/tiny/goal", type=GOAL, fields=fields)

            far = await answer_to(node, send("tiny/odom", 0.0, 300.0, 0.0))
            assert far["level"] == 2, "an error"
            assert "outside the fence" in far["message"]
            held = await asyncio.to_thread(node.call, "/tiny/hold")
            assert held["ok"] is False, "not among telemetry.commands"
            assert ship.mission("kind") == "circle_then_tangent", "nothing has changed"
            north, east = fake_autopilot.state.position[:2] - [0.0, 2.0]
            began_s = time.monotonic()
            answer = await answer_to(node, send("tiny/odom", float(east), float(north), 0.0))
            assert answer["level"] == 0, answer
            sys.stdout.write(f"a goal was accepted after {time.monotonic() - began_s:.3f} s ")
            sys.stdout.write(f"(load average {os.getloadavg()[0]:.1f})\n")
            await until(lambda: ship.mission("arrived") is True, SECONDS_TO_FAIL)
            assert float(np.linalg.norm(fake_autopilot.state.position[:2] - [north, east])) < 1.5
            assert fake_autopilot.mode == "OFFBOARD"
            fields = {"header.frame_id": "tiny/level", "twist.linear.y": 0.3}
            answer = await answer_to(node, lambda: node.do("publish", topic="/tiny/cmd_vel", type=TWIST, fields=fields))
            assert answer["level"] == 0, answer
            await until(lambda: ship.mission("sentence") == "flies an operator's velocity", SECONDS_TO_FAIL)
            # The bridge dies in the midst: the drone flies on, and its order runs out as any operator's.
            running.kill()
            await until(lambda: str(ship.mission("sentence")).startswith("hovers"), SECONDS_TO_FAIL)
            assert fake_autopilot.mode == "OFFBOARD"

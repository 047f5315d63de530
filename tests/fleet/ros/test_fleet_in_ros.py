"""Nodes of other people see the fleet and order it, each in a process of its own: run with `make ros`."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

from flockd.sim.sitl.processes import free_endpoint
from tests.calm import until
from tests.fleet.ros.peers import Peer, bridge, ended, own_domain, peer

pytestmark = [pytest.mark.ros, pytest.mark.slow]

ROOT = Path(__file__).parents[3]
DRONES = tuple(f"drone{number}" for number in range(1, 6))
ODOMETRY = "nav_msgs/msg/Odometry"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
GOAL = "geometry_msgs/msg/PoseStamped"
STATUS = "diagnostic_msgs/msg/DiagnosticStatus"


@contextmanager
def made_up_drones(endpoint: str, *options: str, connect: bool = True) -> Iterator[subprocess.Popen[str]]:
    """`tools.docs.made_up_fleet`: the telemetry of five drones, at 2 Hz; it connects to the endpoint, or listens."""
    where = "--connect" if connect else "--listen"
    command = [sys.executable, "-m", "tools.docs.made_up_fleet", where, endpoint, *options]
    with ended(subprocess.Popen(command, cwd=ROOT, text=True)) as process:
        yield process


def told(what: str, value: float, unit: str) -> None:
    """Figures are printed, as `make ros` shows them: a busy computer does not fail a test of order and outcome."""
    sys.stdout.write(f"{what}: {value:.3f} {unit} (load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores)\n")


class Fleet(NamedTuple):
    """Five drones of which the first three allow to be held, their bridge, and a node that listens."""

    environment: Mapping[str, str]
    endpoint: str
    node: Peer
    bridge: subprocess.Popen[str]


@pytest.fixture(scope="module")
def fleet() -> Iterator[Fleet]:
    environment, endpoint = own_domain(), free_endpoint()
    with ExitStack() as stack:
        node = stack.enter_context(peer(environment, "someone"))
        for drone in DRONES:
            node.listen(f"/{drone}/odometry", ODOMETRY)
        running = stack.enter_context(bridge(environment, "--drones-at", endpoint, "--orders"))
        of_five = ("--flock", "5", "--drones")
        stack.enter_context(made_up_drones(endpoint, *of_five, "3", "--commands", "hold,resume"))
        stack.enter_context(made_up_drones(endpoint, *of_five, "2", "--first", "4"))
        until(lambda: all(node.heard(f"/{drone}/odometry") for drone in DRONES))
        yield Fleet(environment, endpoint, node, running)


def test_a_late_node_sees_all_five_and_their_state_at_once(fleet: Fleet) -> None:
    with peer(fleet.environment, "late") as late:
        began_s = time.monotonic()
        for drone in DRONES:
            late.listen(f"/{drone}/odometry", ODOMETRY)
            late.listen(f"/{drone}/diagnostics", DIAGNOSTICS, "state")
        until(lambda: all(late.heard(f"/{drone}/odometry") for drone in DRONES))
        told("from subscribing until all five drones' odometry came", time.monotonic() - began_s, "s")
        assert {late.newest(f"/{drone}/diagnostics")["status"][0]["hardware_id"] for drone in DRONES} == set(DRONES)
        before = {drone: len(late.heard(f"/{drone}/odometry")) for drone in DRONES}
        until(lambda: all(len(late.heard(f"/{drone}/odometry")) >= before[drone] + 6 for drone in DRONES))
        times = [one["at"] for one in late.heard("/drone1/odometry")]
        told("odometry of drone1", (len(times) - 1) / (times[-1] - times[0]), "Hz, of 2")


def test_what_a_step_tells_is_in_the_drones_namespace(fleet: Fleet) -> None:
    fleet.node.listen("/drone3/neighbours", "geometry_msgs/msg/PoseArray")
    fleet.node.listen("/drone3/neighbours/tracks", "sensor_msgs/msg/PointCloud2")
    fleet.node.listen("/drone3/markers", "visualization_msgs/msg/MarkerArray", "state")
    poses = until(lambda: [m for m in fleet.node.heard("/drone3/neighbours") if m["message"]["poses"]])[-1]["message"]
    assert poses["header"]["frame_id"] == "drone3/level"
    stamp = poses["header"]["stamp"]
    tracks = until(
        lambda: [
            one["message"]
            for one in fleet.node.heard("/drone3/neighbours/tracks")
            if one["message"]["header"]["stamp"] == stamp
        ]
    )[0]
    assert tracks["width"] == len(poses["poses"]), "the same neighbours in the same order"
    drawn = fleet.node.newest("/drone3/markers")["markers"]
    assert {marker["header"]["frame_id"] for marker in drawn} == {"map"}
    assert any("drone3" in marker["text"] for marker in drawn)


def test_a_hold_is_confirmed_and_a_drone_that_allows_none_refuses(fleet: Fleet) -> None:
    fleet.node.listen("/drone1/diagnostics", DIAGNOSTICS, "state")
    fleet.node.newest("/drone1/diagnostics")
    began_s = time.monotonic()
    answer = fleet.node.call("/drone1/hold")
    told("from asking for hold to the drone's answer", answer["took"], "s")
    assert answer["ok"]
    assert "hold is being tried" in answer["text"]
    until(lambda: "an operator asked for Hold" in fleet.node.newest("/drone1/diagnostics")["status"][0]["message"])
    told("and until its diagnostics show it", time.monotonic() - began_s, "s")
    assert fleet.node.call("/drone1/resume")["ok"]
    refused = fleet.node.call("/drone1/land")
    assert not refused["ok"] and "telemetry.commands" in refused["text"]
    assert fleet.node.call("/drone4/hold")["ok"] is False, "it allows nothing"


def test_without_orders_a_stranger_finds_no_service(fleet: Fleet) -> None:
    """A domain in which the same fleet is only watched."""
    endpoint, environment = free_endpoint(), own_domain()
    with (
        bridge(environment, "--drones-at", endpoint),
        made_up_drones(endpoint, "--drones", "1", "--commands", "hold"),
        peer(environment, "stranger") as stranger,
    ):
        stranger.listen("/drone1/odometry", ODOMETRY)
        stranger.newest("/drone1/odometry")
        assert stranger.call("/drone1/hold")["found"] is False


def test_a_peer_that_stops_holds_up_nobody(fleet: Fleet) -> None:
    """A reliable reader of everything stops as by SIGSTOP: the others get all at the same rate, hold is answered."""
    with peer(fleet.environment, "stopped") as stopped:
        for drone in DRONES:
            stopped.listen(f"/{drone}/diagnostics", DIAGNOSTICS, "state")
            stopped.listen(f"/{drone}/markers", "visualization_msgs/msg/MarkerArray", "state")
        stopped.newest("/drone5/diagnostics")
        stopped.process.send_signal(signal.SIGSTOP)
        try:
            before, began_s = len(fleet.node.heard("/drone5/odometry")), time.monotonic()
            until(lambda: len(fleet.node.heard("/drone5/odometry")) >= before + 20)
            told("odometry beside a stopped peer", 20 / (time.monotonic() - began_s), "Hz, of 2")
            assert fleet.node.call("/drone1/resume")["ok"]
        finally:
            stopped.process.send_signal(signal.SIGCONT)

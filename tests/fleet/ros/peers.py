"""Runs `flockd ros` and nodes of somebody else's as processes of their own, in a ROS domain of their own."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.calm import until

FLOCKD = "from flockd.cli import program; program()"


def own_domain() -> dict[str, str]:
    """The environment of a ROS domain that nobody else on this computer uses, and no other computer finds."""
    number = random.SystemRandom().randrange(1, 100)
    return {**os.environ, "ROS_DOMAIN_ID": f"{number}", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


@contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def bridge(environment: Mapping[str, str], *options: str) -> Iterator[subprocess.Popen[str]]:
    """`flockd ros`, once it says that it publishes."""
    command = [sys.executable, "-c", FLOCKD, "ros", *options]
    with ended(subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "is published in its namespace" in line, line
        yield process


class Peer:
    """One node; see `ros_peer.py`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self._said: list[dict[str, Any]] = []
        threading.Thread(target=self._read, daemon=True).start()
        until(lambda: self.said("ready"))

    def do(self, do: str, **order: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": do, **order}) + "\n")
        self.process.stdin.flush()

    def listen(self, topic: str, kind: str, qos: str = "sensor") -> None:
        self.do("listen", topic=topic, type=kind, qos=qos)

    def said(self, key: str) -> list[dict[str, Any]]:
        return [one for one in list(self._said) if key in one]

    def heard(self, topic: str) -> list[dict[str, Any]]:
        return [one for one in self.said("heard") if one["heard"] == topic]

    def newest(self, topic: str) -> Any:
        return until(lambda: self.heard(topic))[-1]["message"]

    def call(self, service: str) -> dict[str, Any]:
        before = len(self.said("answer"))
        self.do("call", service=service)
        answer: dict[str, Any] = until(lambda: self.said("answer")[before:])[0]
        return answer

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._said.append(json.loads(line))


@contextmanager
def peer(environment: Mapping[str, str], name: str) -> Iterator[Peer]:
    """A node in a process of its own."""
    command = [sys.executable, str(Path(__file__).with_name("ros_peer.py")), name]
    started = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with ended(started) as process:
        yield Peer(process)

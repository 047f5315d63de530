"""Measure what one daemon takes: seconds until it is ready, memory, processor; with shipped models and four cameras.

python -m tools.measure.bench_daemon [--seconds 20] [--recording DRONE.mcap] [--json]

A real `flockd run` with the configuration of PX4 SITL, beside a fake autopilot in Hold. Images of 640x480 come from
shared memory (a recording's, or plain ones without drones), 2 sets a second, and it records. Its environment is the one
that systemd's unit gives it. Memory is what Linux calls resident; pages shared with who sends the images are counted
apart. Exit code 1: ready after more than 3 s, or more than 350 MB.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from itertools import islice
from pathlib import Path

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.data import data_path
from flockd.core.messages import Frame
from flockd.flight.inference.feeds import golden_image
from flockd.onboard.recording.reader import Recording
from flockd.onboard.sources import FramePublisher
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.scenario import load
from flockd.sim.sitl.daemons import Daemons
from flockd.sim.sitl.ports import free_endpoint, free_port

READY_BAR_S = 3.0
MEMORY_BAR_MB = 350.0
SETS_HZ = 2.0
SETS = 60
PATIENCE_S = 60.0


def main() -> int:
    """Measure and print; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="after it is ready (20)")
    parser.add_argument("--recording", type=Path, help="of a drone with the same cameras: what this one is shown")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = measure(arguments.seconds, arguments.recording)
    if arguments.json:
        print(json.dumps(found, indent=1))
    else:
        for name, value in found.items():
            print(f"{name:40s} {value:8.2f}")
    return 0 if found["ready, s"] <= READY_BAR_S and found["resident at most, MB"] <= MEMORY_BAR_MB else 1


def measure(seconds: float, recording: Path | None) -> dict[str, float]:
    """Every figure by name."""
    port, endpoint = free_port(), free_endpoint()
    config = at(port, endpoint)
    with tempfile.TemporaryDirectory() as name, FakeAutopilot(port, height_m=2.5):
        folder = Path(name)
        feed = CameraFeed(config, endpoint, recording)
        with Daemons(
            [config], folder=folder, recordings=folder, environment={**os.environ, **of_the_unit()}
        ) as daemons:
            begin = time.monotonic()
            daemons.start()
            program = daemons.programs()[0]
            while not daemons.is_ready(0):
                if program.ended is not None or time.monotonic() - begin > PATIENCE_S:
                    raise SystemExit(f"the daemon did not become ready: {program.last_output()}")
                feed.show()
            ready_s, cpu_s = time.monotonic() - begin, program.cpu_s()
            resident = {}
            until = time.monotonic() + seconds
            while time.monotonic() < until:
                feed.show()
                resident = status_mb(program.process.pid)
            used = (program.cpu_s() - cpu_s) / seconds
        feed.close()
    return {
        "ready, s": ready_s,
        "resident at most, MB": resident["VmHWM"],
        "resident at the end, MB": resident["VmRSS"],
        "of which shared with the frames' sender": resident["RssShmem"],
        "cores used": used,
    }


def at(port: int, endpoint: str) -> DroneConfig:
    """The configuration, with the ports that are free here."""
    config = load(data_path("config") / "px4_sitl.yaml")
    assert isinstance(config, DroneConfig)
    assert config.source is not None
    assert config.autopilot is not None
    shared_memory = config.source.shared_memory.model_copy(update={"connect": (endpoint,)})
    return config.model_copy(
        update={
            "source": config.source.model_copy(update={"shared_memory": shared_memory}),
            "autopilot": config.autopilot.model_copy(update={"address": f"udpin://127.0.0.1:{port}"}),
        }
    )


def of_the_unit() -> dict[str, str]:
    """The environment that systemd gives the daemon."""
    lines = (data_path("systemd") / "flockd.service").read_text(encoding="utf-8").splitlines()
    pairs = " ".join(line.removeprefix("Environment=") for line in lines if line.startswith("Environment="))
    return dict(pair.split("=", 1) for pair in pairs.split())


class CameraFeed:
    """Set after set of what the cameras see, each in its turn."""

    def __init__(self, config: DroneConfig, endpoint: str, recording: Path | None) -> None:
        self._drone = config.name
        self._publisher = FramePublisher(listen=[endpoint])
        if recording is None:
            plain = {c.name: golden_image(c.size_px, i) for i, c in enumerate(config.rig.cameras)}
            # The same image again would be a frozen camera's.
            self._sets = [{name: np.roll(image, 2 * k, axis=1) for name, image in plain.items()} for k in range(SETS)]
        else:
            steps = islice(Recording(recording).steps(), SETS)
            self._sets = [{name: frame.image for name, frame in step.frames.frames.items()} for step in steps]
        self._number, self._due_s = 0, time.monotonic()

    def show(self) -> None:
        """The next set, when it is time for it; returns after a moment in any case."""
        if time.monotonic() >= self._due_s:
            self._number, self._due_s = self._number + 1, self._due_s + 1.0 / SETS_HZ
            now_s = time.monotonic()
            for camera, image in self._sets[self._number % len(self._sets)].items():
                self._publisher.publish(self._drone, Frame(camera, image, now_s, self._number))
        time.sleep(0.01)

    def close(self) -> None:
        """Ends the sending."""
        self._publisher.close()


def status_mb(pid: int) -> dict[str, float]:
    """What Linux says of a process's memory."""
    lines = (line.split() for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines())
    return {words[0].rstrip(":"): int(words[1]) / 1024 for words in lines if words[-1] == "kB"}


if __name__ == "__main__":
    sys.exit(main())

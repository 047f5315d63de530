"""The daemons of a simulated fleet: real `flockd run` processes, each with a configuration of its own."""

from __future__ import annotations

import re
import socket
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import yaml

from flockd.core.config import DroneConfig
from flockd.core.config.drone import RecordingConfig
from flockd.core.config.mission import MissionParameters
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.sitl.autopilots import Ports
from flockd.sim.sitl.processes import Program, Programs

READY, STATUS = "READY=1", "STATUS="
SMALL = {"MALLOC_ARENA_MAX": "2"}
"""As systemd's unit sets it: fewer, fuller pools of memory."""
RECORDING = RecordingConfig(images="jpeg", jpeg_quality=80, quota_mb=100000.0)
"""One file for a flight, which costs the daemon little."""
_RUN = "from flockd import program; program()"


def fleet_configs(
    scenario: ScenarioConfig, sitl: DroneConfig, *, ports: Sequence[Ports], endpoint: str, speed_factor: float
) -> tuple[DroneConfig, ...]:
    """The configuration of each drone of a scenario that is not flown by hand.

    The pilot is the scenario's, with the mission's places counted from the drone's own home, which is below its start;
    source, autopilot, safety and telemetry are those of ``sitl``, which has all of them; images come for each step.
    """
    assert sitl.source is not None and sitl.autopilot is not None
    configs, fleet = [], re.sub(r"[^A-Za-z0-9_.-]+", "-", scenario.scenario)
    rate_hz = max(sitl.source.shared_memory.rate_hz, 1.0 / scenario.drone.step_s)
    for i, port in ((i, port) for i, port in enumerate(ports) if not scenario.vehicles[i].by_hand):
        name = f"drone{i + 1}"
        frames = {"drone": name, "connect": (endpoint,), "speed_factor": speed_factor, "rate_hz": rate_hz}
        shared_memory = sitl.source.shared_memory.model_copy(update=frames)
        address = {"address": f"udpin://127.0.0.1:{port.offboard}", "system_id": i + 1}
        parts = {
            "name": name,
            "source": sitl.source.model_copy(update={"shared_memory": shared_memory}),
            "autopilot": sitl.autopilot.model_copy(update=address),
            "mission": _from_home(scenario, i),
            "safety": sitl.safety,
            "telemetry": sitl.telemetry.model_copy(update={"fleet": fleet}),
            "recording": RECORDING,
        }
        configs.append(scenario.drone.model_copy(update=parts))
    return tuple(configs)


def _from_home(scenario: ScenarioConfig, vehicle: int) -> MissionParameters:
    """A vehicle's mission, whose places count from the world's origin in the scenario."""
    mission = scenario.drone_of(vehicle).mission
    north_m, east_m, _ = scenario.vehicles[vehicle].position_m
    return mission.model_copy(update={"origin_m": (mission.origin_m[0] - north_m, mission.origin_m[1] - east_m)})


class Daemons(ExitStack):
    """One `flockd run` for each configuration, between ``__enter__`` and ``__exit__``; listens as systemd would."""

    def __init__(
        self, configs: Sequence[DroneConfig], *, folder: Path, recordings: Path, environment: Mapping[str, str]
    ) -> None:
        """Configurations and logs go to ``folder``, recordings to ``recordings``; sockets to ``folder`` too.

        Args:
            configs: of the drones.
            folder: an existing one, whose path is short enough for a socket.
            recordings: an existing one.
            environment: this process's own.
        """
        super().__init__()
        self._configs, self._folder = configs, folder
        self._recordings = recordings.resolve()  # daemons run in `folder`
        self._environment = {**environment, **SMALL}
        self._listeners = [self.enter_context(_Listener(folder / config.name)) for config in configs]
        self._programs = self.enter_context(Programs())

    def start(self) -> None:
        """Starts all daemons."""
        for config, listener in zip(self._configs, self._listeners, strict=True):
            file = self._folder / f"{config.name}.yaml"
            values = config.model_dump(mode="json", exclude_defaults=True)
            file.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
            options = ["--config", str(file), "--record", str(self._recordings), "--force"]  # a study may go beyond
            self._programs.start(
                config.name,
                [sys.executable, "-c", _RUN, "run", *options],
                {**self._environment, "NOTIFY_SOCKET": str(listener.path)},
                self._folder,
                self._folder / f"{config.name}.log",
            )

    def programs(self) -> tuple[Program, ...]:
        """The daemons in the order of the configurations."""
        return tuple(self._programs)

    def status(self, number: int) -> str:
        """The last status line of a daemon, from 0; empty before it has started."""
        return self._listeners[number].heard().status

    def is_ready(self, number: int) -> bool:
        """Whether a daemon's networks are loaded, its autopilot is connected and frames arrive."""
        return self._listeners[number].heard().ready

    def end(self) -> dict[str, int]:
        """Ends all with SIGTERM: standstill, Hold, the end of the recording. Returns exit codes by name."""
        self._programs.end()
        return {program.name: program.process.returncode for program in self._programs}


class _Listener(socket.socket):
    """The notifications of one daemon, as for a service manager."""

    def __init__(self, base: Path) -> None:
        self.path = base.with_suffix(".notify")
        self.ready, self.status = False, ""
        super().__init__(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.bind(str(self.path))
        self.setblocking(False)

    def heard(self) -> Self:
        """Takes in all that has come."""
        while True:
            try:
                lines = self.recv(4096).decode(errors="replace").splitlines()
            except BlockingIOError:
                return self
            self.ready = self.ready or READY in lines
            for line in lines:
                if line.startswith(STATUS):
                    self.status = line.removeprefix(STATUS)

"""A run of PX4 SITL that leaves nothing behind, PX4's shell, and a ground station that meddles."""

from __future__ import annotations

import os
import struct
import subprocess
from abc import ABC, abstractmethod
from contextlib import ExitStack
from typing import Self

import pytest
from pymavlink.dialects.v20 import development as mavlink

from flockd.core.data import data_path
from flockd.core.errors import UnavailableError
from flockd.core.messages import FloatArray
from flockd.sim.flock.start import with_drones
from flockd.sim.scenario import ScenarioConfig, load_scenario
from flockd.sim.sitl.autopilots import px4_folder
from flockd.sim.sitl.ground_station import GroundStation

PX4 = pytest.mark.skipif("FLOCKD_PX4" not in os.environ, reason="FLOCKD_PX4 names no SITL build folder of PX4")


def one_drone(height_m: float) -> ScenarioConfig:
    """PX4's flight with one drone, which begins this high."""
    scenario = with_drones(load_scenario(data_path("config") / "px4_flight.yaml"), 1)
    place = scenario.vehicles[0].model_copy(update={"position_m": (0.0, 0.0, -height_m)})
    return scenario.model_copy(update={"vehicles": (place,)})


class SitlRun(ABC):
    """One PX4 and what runs beside it, all on ``_stack``, between ``__enter__`` and ``__exit__``."""

    def __init__(self, instance: int = 0) -> None:
        self._instance = instance
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        try:
            self._come_up()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @abstractmethod
    def _come_up(self) -> None:
        """Starts everything. Raises UnavailableError."""

    def shell(self, *command: str) -> None:
        """Runs a command in PX4's shell. Raises UnavailableError."""
        program = px4_folder(os.environ) / f"bin/px4-{command[0]}"
        done = subprocess.run(
            [program, "--instance", str(self._instance), *command[1:]],
            capture_output=True, text=True, check=False, timeout=60.0,
        )  # fmt: skip
        if done.returncode != 0:
            raise UnavailableError(f"PX4 refused `{' '.join(command)}`: {(done.stdout + done.stderr).strip()}")


class Meddler(GroundStation):
    """A ground station that sets parameters, moves sticks, and sends setpoints of its own."""

    def texts(self, number: int) -> list[str]:
        """All its STATUSTEXTs so far, whole, in turn: of two at once nobody may read the first while it is the last."""
        return list(self._vehicles[number].texts)

    def push_sticks(self, number: int, *, forward: int) -> None:
        """Sends the position of a joystick's sticks once: in the middle but for `forward`, -1000 to 1000."""
        vehicle = self._vehicles[number]
        with self._lock:
            vehicle.mav.manual_control_send(vehicle.number + 1, forward, 0, 500, 0, 0)

    def set_parameter(self, number: int, name: str, value: int | float) -> None:
        """Sends a parameter: an int for an INT32, a float for a REAL32."""
        vehicle = self._vehicles[number]
        kind = mavlink.MAV_PARAM_TYPE_INT32 if isinstance(value, int) else mavlink.MAV_PARAM_TYPE_REAL32
        # PX4 takes an integer's bytes where MAVLink has a float.
        wire = struct.unpack("<f", struct.pack("<i", value))[0] if isinstance(value, int) else value
        with self._lock:
            vehicle.mav.param_set_send(vehicle.number + 1, 1, name.encode(), wire, kind)

    def send_velocity(self, number: int, velocity: FloatArray) -> None:
        """Sends a setpoint once, as flockd does: a velocity (2,) m/s north and east, level."""
        vehicle = self._vehicles[number]
        with self._lock:
            vehicle.mav.set_position_target_local_ned_send(
                0, vehicle.number + 1, 1, 1, 2503, 0, 0, 0, *velocity, 0, 0, 0, 0, 0, 0
            )

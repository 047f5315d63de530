"""Autopilots for the daemons of a simulated fleet: PX4 in software, or fake autopilots."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flockd.core.errors import UnavailableError, UsageError
from flockd.core.messages import FloatArray
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.autopilot.fake_range_finder import FakeRangeFinder, Ground
from flockd.sim.autopilot.fake_vehicle import Flown
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.sitl.ground_station import FULL_STICK_M_S, home_deg
from flockd.sim.sitl.processes import Program, Programs, free_port

PX4_FOLDER = "FLOCKD_PX4"
"""The environment variable that names PX4's SITL build folder."""
OFFBOARD_PORT, TRUTH_PORT = 14540, 19410
"""Ports of PX4's instance 0."""
MAX_INSTANCES = 10
"""PX4 sends all further ones to one port."""
PARAMETERS = {
    "SIH_KDV": "0.1",  # drag; with the default of 1.0 it takes eight seconds to reach 3 m/s
    # PX4's simulated IMU has more noise than its estimator expects. With these, velocity errs by 0.15 m/s instead of
    # 0.4, and the heading by 2 degrees instead of up to 10.
    "EKF2_GYR_NOISE": "0.1",
    "EKF2_ACC_NOISE": "1.0",
    "EKF2_MAG_NOISE": "0.02",
    # Simulated seconds, as by default: PX4's start script multiplies them by the speed factor, and a slow simulator
    # would disarm before it takes off.
    "COM_OF_LOSS_T": "1.0",
    "COM_RC_LOSS_T": "0.5",
    "COM_DL_LOSS_T": "10",
    "COM_DISARM_PRFLT": "10.0",
    "COM_OBL_RC_ACT": "5",
    "SDLOG_BACKEND": "0",
}
"""Parameters of all instances."""
BY_HAND = {
    "COM_RC_IN_MODE": "1",  # sticks come over MAVLink
    "MPC_VEL_MANUAL": f"{FULL_STICK_M_S:g}",
    "MAN_DEADZONE": "0",  # a person who leads slowly hardly moves a stick
    "MPC_HOLD_DZ": "0",  # the same before PX4 1.18
}
"""Parameters of an instance that a person flies in Position mode, too."""


@dataclass(frozen=True)
class Ports:
    """UDP ports of one vehicle on this computer."""

    offboard: int
    """Where its daemon listens."""
    truth: int
    """Where the simulator does."""


class Autopilots(ExitStack, ABC):
    """One autopilot a vehicle, on the ground below its start until it is commanded to take off.

    Between ``__enter__`` and ``__exit__``.
    """

    name: str
    """For the report."""
    ports: tuple[Ports, ...]

    def __init__(self, scenario: ScenarioConfig, speed_factor: float) -> None:
        super().__init__()
        self._scenario, self._speed_factor = scenario, speed_factor
        self._programs = self.enter_context(Programs())

    @abstractmethod
    def start(self) -> None:
        """Starts all autopilots."""

    def programs(self) -> Sequence[Program]:
        """The autopilots that run as programs of their own."""
        return tuple(self._programs)


class SimulatedAutopilots(Autopilots):
    """Fake autopilots (`flockd.sim.autopilot`) on the simulator's own vehicle model."""

    name = "fake autopilot"

    def __init__(self, scenario: ScenarioConfig, speed_factor: float, ground: Ground) -> None:
        """``ground``: the world's ground, to which range finders measure."""
        super().__init__(scenario, speed_factor)
        self._ground = ground
        self.ports = tuple(Ports(free_port(), free_port()) for _ in scenario.vehicles)
        self.fakes: list[FakeAutopilot] = []

    def start(self) -> None:
        """See `Autopilots`."""
        for i, (vehicle, ports) in enumerate(zip(self._scenario.vehicles, self.ports, strict=True)):
            position = np.array(vehicle.position_m)
            fake = FakeAutopilot(
                ports.offboard,
                system_id=i + 1,
                motion=Flown(np.zeros(3), config=self._scenario.vehicle, seed=self._scenario.seed + i, leans=True),
                home_deg=home_deg(position),
                truth_port=ports.truth,
                speed_factor=self._speed_factor,
                range_finder=self._range_finder(i, position),
            )
            fake.parameters["MIS_TAKEOFF_ALT"] = -float(position[2])
            fake.parameters["MPC_VEL_MANUAL"] = FULL_STICK_M_S
            fake.parameters["MAN_DEADZONE"] = 0.0
            self.fakes.append(self.enter_context(fake))

    def _range_finder(self, number: int, home: FloatArray) -> FakeRangeFinder | None:
        """A vehicle's, which counts its position from home."""
        config, ground = self._scenario.sensors.range_finder, self._ground
        if config is None:
            return None
        seed = self._scenario.seed, number, 2
        return FakeRangeFinder(config, lambda north, east: ground(north + home[0], east + home[1]), seed)


class Px4s(Autopilots):
    """Instances of PX4 SITL that fly its own simulated quadrotor (SIH)."""

    name = "PX4 SITL"

    def __init__(
        self,
        scenario: ScenarioConfig,
        speed_factor: float,
        environment: Mapping[str, str],
        folder: Path,
        parameters: Mapping[str, str] | None = None,
        first: int = 0,
    ) -> None:
        """Each works in a folder under ``folder``, from number ``first`` on; ``parameters`` win over `PARAMETERS`.

        Raises UnavailableError where there is no PX4.
        """
        if first + len(scenario.vehicles) > MAX_INSTANCES:
            raise UsageError(f"PX4 gives ports to {MAX_INSTANCES} vehicles, not {len(scenario.vehicles)}; fly fewer")
        super().__init__(scenario, speed_factor)
        self._build, self._folder = px4_folder(environment), folder
        self._instances = range(first, first + len(scenario.vehicles))
        self._environment = dict(environment)
        self._parameters = {**PARAMETERS, **(parameters or {})}
        self.ports = tuple(Ports(OFFBOARD_PORT + i, TRUTH_PORT + i) for i in self._instances)

    def start(self) -> None:
        """See `Autopilots`."""
        for i, vehicle in zip(self._instances, self._scenario.vehicles, strict=True):
            position = np.array(vehicle.position_m)
            latitude_deg, longitude_deg = home_deg(position)
            parameters = BY_HAND | self._parameters if vehicle.by_hand else self._parameters
            working = self._folder / f"px4_{i}"
            working.mkdir(parents=True)
            settings = {
                "PX4_SIM_MODEL": "sihsim_quadx",
                "PX4_SIM_SPEED_FACTOR": f"{self._speed_factor:g}",
                "PX4_HOME_LAT": f"{latitude_deg:.9f}",
                "PX4_HOME_LON": f"{longitude_deg:.9f}",
                "PX4_HOME_ALT": "0",
                "PX4_PARAM_MIS_TAKEOFF_ALT": f"{-position[2]:g}",
                **{f"PX4_PARAM_{name}": value for name, value in parameters.items()},
            }
            command = [str(self._build / "bin/px4"), "-i", f"{i}", "-d", str(self._build / "etc"), "-w", str(working)]
            log = self._folder / f"px4_{i}.log"
            self._programs.start(f"PX4 instance {i}", command, {**self._environment, **settings}, working, log)


def px4_folder(environment: Mapping[str, str]) -> Path:
    """PX4's SITL build folder. Raises UnavailableError where none is named or it holds no PX4."""
    named = environment.get(PX4_FOLDER)
    wanted = "set it to PX4's SITL build folder, which holds bin/px4 and etc/"
    if not named:
        raise UnavailableError(f"there is no PX4: {PX4_FOLDER} is not set; {wanted}")
    folder = Path(named).absolute()
    if not os.access(folder / "bin/px4", os.X_OK) or not (folder / "etc").is_dir():
        raise UnavailableError(f"there is no PX4 in {folder}, which {PX4_FOLDER} names; {wanted}")
    return folder

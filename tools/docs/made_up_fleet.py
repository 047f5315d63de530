"""Publishes a made-up flock's telemetry with the real messages, queries and access rules: for the fleet page.

python -m tools.docs.made_up_fleet --drones 5 --commands hold,land    # and beside it: flockd fleet
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import math
import os
from collections.abc import Sequence
from typing import get_args

import cv2
import numpy as np

from flockd import __version__
from flockd.core.config import load_drone
from flockd.core.config.drone import OperatorCommand
from flockd.core.data import data_path
from flockd.core.messages import (
    SECTORS,
    FloatArray,
    MissionStatus,
    Neighbour,
    ObstacleRanges,
    PilotOutput,
    VehicleState,
    Wanted,
)
from flockd.flight.safety import State
from flockd.onboard.daemon.operator_orders import OperatorCommands, OperatorRequests
from flockd.onboard.telemetry import publish_step
from flockd.onboard.telemetry.publisher import DEFAULT_ENDPOINT, ZenohTelemetry
from flockd.onboard.telemetry.topics import (
    AboutMessage,
    CameraMessage,
    ComputerMessage,
    FlightMessage,
    ReasonMessage,
)

FLEET = "made-up"
CAMERAS = ("front", "back")
RATE_HZ = 2.0
RADIUS_M, SPEED_M_S, HEIGHT_M, SPACING_M, SIGHT_M = 25.0, 1.5, 5.0, 3.5, 6.5
HOME_DEG = np.array([47.3977, 8.5456])
TREES = np.array([[12.0, 20.0], [-6.0, 33.0], [30.0, 2.0], [-15.0, -22.0], [8.0, -34.0], [35.0, 25.0]])
"""(n, 2) metres north and east."""
TREE_M, TREES_SEEN_M = 0.4, 15.0


def main() -> int:
    """Publishes until Ctrl-C, or until it is killed."""
    parser = argparse.ArgumentParser(description="Publishes a made-up flock's telemetry.")
    parser.add_argument("--drones", type=int, default=5)
    parser.add_argument("--flock", type=int, help="drones in all, where other processes publish the others")
    parser.add_argument("--first", type=int, default=1, help="number of the first drone")
    parser.add_argument("--commands", default="", help=f"of {', '.join(get_args(OperatorCommand))}")
    parser.add_argument("--listen", default=DEFAULT_ENDPOINT)
    parser.add_argument(
        "--connect", action="append", default=[], help="where a watcher listens, in the place of --listen"
    )
    args = parser.parse_args()
    listen = [] if args.connect else [args.listen]
    numbers = range(args.first, args.first + args.drones)
    with ZenohTelemetry(FLEET, listen=listen, connect=args.connect) as telemetry:
        try:
            commands = [one for one in args.commands.split(",") if one]
            flock = args.flock or args.drones
            asyncio.run(_publish(telemetry, numbers, flock, commands))
        except KeyboardInterrupt:
            return 0
    return 0


async def _publish(telemetry: ZenohTelemetry, numbers: Sequence[int], flock: int, commands: list[str]) -> None:
    loop = asyncio.get_running_loop()
    drones = [MadeUpDrone(telemetry, number, flock, commands, loop) for number in numbers]
    began_s = loop.time()
    for step in itertools.count():
        time_s = step / RATE_HZ
        places, velocity = flying(time_s, flock)
        for drone in drones:
            drone.step(time_s, places, velocity)
        await asyncio.sleep(max(0.0, began_s + (step + 1) / RATE_HZ - loop.time()))


def flying(time_s: float, drones: int) -> tuple[FloatArray, FloatArray]:
    """(n, 2) metres of all, in a grid that flies a circle, and their velocity (2,) in m/s, north and east."""
    angle, number = time_s * SPEED_M_S / RADIUS_M, np.arange(drones)
    middle = RADIUS_M * np.array([math.cos(angle), math.sin(angle)])
    sway = 0.4 * np.stack([np.sin(0.7 * time_s + number), np.cos(0.5 * time_s + 2 * number)], axis=1)
    grid = SPACING_M * np.stack([number % 7 - 2.0, number // 7 - 1.0 + 0.5 * (number % 2)], axis=1)
    return middle + grid + sway, SPEED_M_S * np.array([-math.sin(angle), math.cos(angle)])


class MadeUpDrone:
    """Circles in a grid of drones; holds, lands and resumes when it is asked to."""

    def __init__(
        self, telemetry: ZenohTelemetry, number: int, flock: int, commands: list[str], loop: asyncio.AbstractEventLoop
    ) -> None:
        """``flock``: number of drones in all; it sees the nearest."""
        self._flock = flock
        self._telemetry, self._number, self.name = telemetry, number, f"drone{number}"
        self._requests = OperatorRequests()
        self._times = itertools.count()
        self._steps = 0
        self._held: FloatArray | None = None
        self._was = ""
        config = load_drone(data_path("config") / "simulator.yaml")
        about = AboutMessage(version=__version__, configuration=config.model_dump(mode="json"), commands=commands)
        self._commands = OperatorCommands(
            commands, self._requests, loop, self._event, order_fault=lambda order: None, fly=lambda order: None,
            state=lambda: State.NORMAL, identity=telemetry.identity,
        )  # fmt: skip
        telemetry.announce(self.name, about, self._commands.handle, self._image)

    def step(self, time_s: float, places: FloatArray, velocity: FloatArray) -> None:
        """Publishes one step, of a flock that is at ``places`` (n, 2) and has one velocity (2,)."""
        self._steps += 1
        wanted = "hold" if self._requests.hold else "land" if self._requests.land else "offboard"
        if wanted != self._was:
            self._event(f"the autopilot flies {wanted}")
            self._was = wanted
        place = places[self._number - 1]
        if wanted == "offboard":
            self._held = None
        else:
            self._held = place if self._held is None else self._held
            place, velocity = self._held, np.zeros(2)
        vehicle, output = self._output(time_s, places, place, velocity)
        publish_step(self._telemetry, self.name, vehicle, output)
        self._telemetry.publish(self.name, "flight", {**self._flight(time_s, vehicle.height_m, wanted)})
        if self._steps % 2:
            self._telemetry.publish(self.name, "computer", {**self._computer(time_s)})

    def _output(
        self, time_s: float, places: FloatArray, place: FloatArray, velocity: FloatArray
    ) -> tuple[VehicleState, PilotOutput]:
        yaw = math.atan2(velocity[1], velocity[0]) if velocity.any() else 0.0
        turn = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        height_m = HEIGHT_M + 0.3 * math.sin(0.4 * time_s + self._number)
        moving = np.array([*velocity, 0.0])
        vehicle = VehicleState(time_s, turn, height_m, moving, place, HOME_DEG)
        offsets = places - place
        near = np.flatnonzero(np.hypot(offsets[:, 0], offsets[:, 1]) < SIGHT_M)
        neighbours = tuple(
            Neighbour(int(i) + 1, np.array([*offsets[i], 0.0]), moving, 0.15, 0.1, 10.0, 0.0, 9, confirmed=True)
            for i in near
            if i != self._number - 1
        )
        command = Wanted(velocity, np.zeros(2), yaw)
        mission = MissionStatus("circle_then_tangent", velocity, "circles", goal=np.zeros(2))
        output = PilotOutput(
            time_s, None, moving, (), (), neighbours, command, mission=mission, obstacles=_obstacles(time_s, place)
        )
        return vehicle, output

    def _flight(self, time_s: float, height_m: float, wanted: str) -> FlightMessage:
        reasons = {"hold": "an operator asked for Hold", "land": "an operator asked for Land"}
        tired = self._number % 5 == 3 and wanted == "offboard"
        sentence = "camera back delivers no frames; check its cable" if tired else reasons.get(wanted)
        return FlightMessage(
            time_s=time_s,
            state="degraded" if tired else "normal" if wanted == "offboard" else "asking",
            reasons=[] if sentence is None else [ReasonMessage(event="made_up", sentence=sentence)],
            flight_mode=wanted, armed=True, in_air=True, heartbeat_age_s=0.1, heartbeats_lost=0,
            battery_share=max(0.1, 0.9 - 0.02 * self._number - time_s / 3000), height_m=height_m,
            velocity_trim=[0.0, 0.0], velocity_error_m_s=0.1, silence=None, setpoints_sent=20 * self._steps,
            setpoints_missed=self._number, orders=self._commands.recent(), orders_refused=self._commands.refused,
        )  # fmt: skip

    def _computer(self, time_s: float) -> ComputerMessage:
        cameras = {name: CameraMessage(age_s=0.03, fault=None, counts={}) for name in CAMERAS}
        return ComputerMessage(
            time_s=time_s, cameras=cameras,
            load=0.5 + 0.1 * math.sin(0.2 * time_s + self._number), steps=self._steps, steps_failed=0, network_faults=0,
            networks_stuck=0, loop_lag_s=0.002, temperature_c=55.0 + self._number % 20 + 3 * math.sin(0.05 * time_s),
            messages_lost=0, recording=None,
        )  # fmt: skip

    def _event(self, sentence: str) -> None:
        self._telemetry.publish(self.name, "events", {"time_s": self._steps / 2.0, "event": sentence})

    def _image(self, camera: str) -> bytes | None:
        """A picture with the drone's name, as JPEG; None for an unknown camera."""
        image = np.full((240, 320, 3), (140, 110, 70), np.uint8)
        image[150:] = (60, 110, 80)
        cv2.circle(image, (90 + 10 * (self._steps % 14), 120), 14, (0, 109, 255), 1, cv2.LINE_AA)
        text = f"{self.name} {camera} {os.getpid()}"
        cv2.putText(image, text, (8, 230), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        return bytes(cv2.imencode(".jpg", image)[1]) if camera in CAMERAS else None


def _obstacles(time_s: float, place: FloatArray) -> ObstacleRanges:
    """The trees as a drone at ``place`` (2,), m, sees them."""
    ranges = np.full(SECTORS, np.inf)
    for offset in TREES - place:
        far = float(np.hypot(*offset)) - TREE_M
        if far < TREES_SEEN_M:
            sector = round(math.atan2(offset[1], offset[0]) / (2 * math.pi / SECTORS)) % SECTORS
            ranges[sector] = min(ranges[sector], far)
    return ObstacleRanges(time_s, ranges, np.where(np.isfinite(ranges), 0.1, 0.0), np.full(SECTORS, TREES_SEEN_M))


if __name__ == "__main__":
    raise SystemExit(main())

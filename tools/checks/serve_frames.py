"""Renders and publishes what the cameras of PX4 SITL's vehicles see, for daemons that are started by hand.

    python -m tools.checks.serve_frames config/px4_flight.yaml --drones 2 --speed-factor 0.25

The poses are the true ones that PX4's simulated vehicle (SIH) sends to UDP port 19410 + N; vehicle N is published as
drone N+1 at the endpoint that config/px4_sitl.yaml connects to. `flockd sim --autopilot px4` does all of this itself.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from flockd.onboard.simulated_time import clock_at
from flockd.sim.cameras.camera_simulator import CameraSimulator
from flockd.sim.flock.start import with_drones
from flockd.sim.scenario import load_scenario
from flockd.sim.sitl.autopilots import TRUTH_PORT
from flockd.sim.sitl.frame_server import FrameServer
from flockd.sim.sitl.ground_station import GroundStation

ENDPOINT = "tcp/127.0.0.1:7448"
RATE_HZ = 2.0
"""Frame sets a second of simulated time: one for each step."""
POLL_S = 0.2


def main() -> None:
    """Waits for all vehicles, then serves until Ctrl-C."""
    parser = argparse.ArgumentParser(description="Serves the camera frames of PX4 SITL's vehicles.")
    parser.add_argument("scenario", type=Path, help="for the world and the drones' cameras")
    parser.add_argument("--drones", type=int, required=True, help="PX4 instances, counted from 0")
    parser.add_argument("--speed-factor", type=float, default=1.0, help="of PX4 and the daemons (1)")
    parser.add_argument("--endpoint", default=ENDPOINT, help=f"of zenoh, where frames are published ({ENDPOINT})")
    parser.add_argument("--first-port", type=int, default=TRUTH_PORT, help=f"of instance 0's true pose ({TRUTH_PORT})")
    args = parser.parse_args()
    scenario = with_drones(load_scenario(args.scenario), args.drones)
    names = [f"drone{number + 1}" for number in range(args.drones)]
    clock = clock_at(args.speed_factor)
    ports = [args.first_port + number for number in range(args.drones)]
    with (
        GroundStation(ports, clock) as station,
        FrameServer(
            CameraSimulator(scenario), names, endpoint=args.endpoint, rate_hz=RATE_HZ, poses=station.poses, clock=clock,
            speed_factor=args.speed_factor,
        ) as server,
    ):  # fmt: skip
        missing = names
        while missing:
            missing = [name for number, name in enumerate(names) if not station.is_connected(number)]
            if missing:
                print(f"waiting for the poses of {', '.join(missing)}", flush=True)
                time.sleep(5 * POLL_S)
                station.request_messages()
        server.start()
        print(f"serving {', '.join(names)} at {args.endpoint}; Ctrl-C ends it", flush=True)
        try:
            while True:
                time.sleep(POLL_S)
                server.frames()  # raises what ended its thread
        except KeyboardInterrupt:
            print(f"served {len(server.frames())} frame sets a drone")


if __name__ == "__main__":
    main()

"""Turns one step of the pilot into messages, and hands them to a sink."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

from flockd.core.messages import Neighbour, PilotOutput, VehicleState
from flockd.flight.geometry import euler_from_rotation
from flockd.onboard.telemetry import topics


class TelemetrySink(Protocol):
    """Takes messages and never makes the caller wait."""

    def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
        """Publishes one message of one drone under a key of `TOPICS`."""


def publish_step(sink: TelemetrySink, drone: str, vehicle: VehicleState, output: PilotOutput) -> None:
    """Publishes all messages of one step of one drone's pilot."""
    time_s, command, mission, obstacles = output.time_s, output.command, output.mission, output.obstacles
    roll_deg, pitch_deg, yaw_deg = map(math.degrees, euler_from_rotation(vehicle.R_ned_body))
    position_ne = None if vehicle.position is None else vehicle.position.tolist()
    state = topics.StateMessage(
        time_s=time_s,
        height_m=vehicle.height_m,
        roll_deg=roll_deg,
        pitch_deg=pitch_deg,
        yaw_deg=yaw_deg,
        velocity_ned=None if output.velocity is None else output.velocity.tolist(),
        position_ne=position_ne,
        home_deg=None if vehicle.home_deg is None else vehicle.home_deg.tolist(),
    )
    sink.publish(drone, "state", state)
    neighbours = [neighbour_message(neighbour) for neighbour in output.neighbours]
    sink.publish(drone, "neighbours", topics.NeighboursMessage(time_s=time_s, neighbours=neighbours))
    if obstacles is not None:  # rounded to centimetres
        range_m, seen_m = obstacles.range_m.round(2).tolist(), obstacles.seen_m.round(2).tolist()
        sink.publish(
            drone, "obstacles", topics.ObstaclesMessage(time_s=obstacles.time_s, range_m=range_m, seen_m=seen_m)
        )
    asked = topics.CommandMessage(
        time_s=time_s,
        velocity_ne=command.velocity.tolist(),
        acceleration_ne=command.acceleration.tolist(),
        yaw_deg=None if command.yaw_rad is None else math.degrees(command.yaw_rad),
    )
    sink.publish(drone, "command", asked)
    if mission.known:
        told = topics.MissionMessage(
            time_s=time_s,
            kind=mission.kind,
            sentence=mission.sentence,
            goal_ne=None if mission.goal is None else mission.goal.tolist(),
            goal_height_m=mission.goal_height_m,
            position_ne=position_ne,
            arrived=mission.arrived,
        )
        sink.publish(drone, "mission", told)


def neighbour_message(neighbour: Neighbour) -> topics.NeighbourMessage:
    """One neighbour as a telemetry message."""
    return topics.NeighbourMessage(
        track=neighbour.track,
        position_ned=neighbour.position.tolist(),
        velocity_ned=neighbour.velocity.tolist(),
        position_sigma_m=neighbour.position_sigma_m,
        velocity_sigma_m_s=neighbour.velocity_sigma_m_s,
        age_s=neighbour.age_s,
        unseen_s=neighbour.unseen_s,
        confirmed=neighbour.confirmed,
    )

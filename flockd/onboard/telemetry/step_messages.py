"""Turns what one step of the pilot found into messages, and hands them to a sink."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

from flockd.core.messages import MissionStatus, Neighbour, ObstacleRanges, PilotOutput, VehicleState
from flockd.onboard.telemetry.topics import (
    CommandMessage,
    HealthMessage,
    MissionMessage,
    NeighbourMessage,
    NeighboursMessage,
    ObstaclesMessage,
    StateMessage,
    TimingsMessage,
)


class TelemetrySink(Protocol):
    """Takes messages and never makes the caller wait."""

    def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
        """Publishes one message of one drone under a key of `TOPICS`."""


def publish_step(sink: TelemetrySink, drone: str, vehicle: VehicleState, output: PilotOutput) -> None:
    """Publishes all that one step of one drone's pilot has to tell."""
    sink.publish(drone, "state", _state(vehicle, output))
    sink.publish(drone, "neighbours", _neighbours(output))
    if output.obstacles is not None:
        sink.publish(drone, "obstacles", _obstacles(output.obstacles))
    sink.publish(drone, "command", _command(output))
    if output.mission.known:
        sink.publish(drone, "mission", _mission(output.time_s, vehicle, output.mission))
    sink.publish(drone, "health", _health(output))
    sink.publish(drone, "timings", TimingsMessage(time_s=output.time_s, stages_ms=dict(output.stages_ms)))


def _state(vehicle: VehicleState, output: PilotOutput) -> StateMessage:
    R = vehicle.R_ned_body
    return StateMessage(
        time_s=output.time_s,
        height_m=vehicle.height_m,
        roll_deg=math.degrees(math.atan2(R[2, 1], R[2, 2])),
        pitch_deg=math.degrees(math.asin(max(-1.0, min(1.0, -R[2, 0])))),
        yaw_deg=math.degrees(math.atan2(R[1, 0], R[0, 0])),
        velocity_ned=None if output.velocity is None else output.velocity.tolist(),
        position_ne=None if vehicle.position is None else vehicle.position.tolist(),
        home_deg=None if vehicle.home_deg is None else vehicle.home_deg.tolist(),
    )


def _neighbours(output: PilotOutput) -> NeighboursMessage:
    return NeighboursMessage(
        time_s=output.time_s, neighbours=[neighbour_message(neighbour) for neighbour in output.neighbours]
    )


def neighbour_message(neighbour: Neighbour) -> NeighbourMessage:
    """One neighbour, as telemetry has it."""
    return NeighbourMessage(
        track=neighbour.track,
        position_ned=neighbour.position.tolist(),
        velocity_ned=neighbour.velocity.tolist(),
        position_sigma_m=neighbour.position_sigma_m,
        velocity_sigma_m_s=neighbour.velocity_sigma_m_s,
        age_s=neighbour.age_s,
        unseen_s=neighbour.unseen_s,
        confirmed=neighbour.confirmed,
    )


def _obstacles(obstacles: ObstacleRanges) -> ObstaclesMessage:
    """To the centimetre."""
    return ObstaclesMessage(
        time_s=obstacles.time_s, range_m=obstacles.range_m.round(2).tolist(), seen_m=obstacles.seen_m.round(2).tolist()
    )


def _command(output: PilotOutput) -> CommandMessage:
    return CommandMessage(
        time_s=output.time_s,
        velocity_ne=output.command.velocity.tolist(),
        acceleration_ne=output.command.acceleration.tolist(),
        yaw_deg=None if output.command.yaw_rad is None else math.degrees(output.command.yaw_rad),
    )


def _mission(time_s: float, vehicle: VehicleState, mission: MissionStatus) -> MissionMessage:
    return MissionMessage(
        time_s=time_s,
        kind=mission.kind,
        sentence=mission.sentence,
        goal_ne=None if mission.goal is None else mission.goal.tolist(),
        goal_height_m=mission.goal_height_m,
        position_ne=None if vehicle.position is None else vehicle.position.tolist(),
        arrived=mission.arrived,
    )


def _health(output: PilotOutput) -> HealthMessage:
    return HealthMessage(
        time_s=output.time_s,
        ok=not output.reasons,
        reasons=[reason.text for reason in output.reasons],
        refused=dict(output.counts),
    )

"""The table of all events and reactions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, StrEnum, auto

from flockd.core.config.safety import SafetyParameters
from flockd.flight.safety.events import Event


class Reaction(IntEnum):
    """The reaction in flight; of several the worst applies."""

    NOTE = auto()
    """Fly on, and report it."""
    DEGRADE = auto()
    """Fly on, slower and farther from neighbours."""
    HOVER = auto()
    """Stand still; if the event lasts, hold."""
    HOLD = auto()
    """Stand still and ask the autopilot to take over: in Hold, to return home, or to land."""
    RETURN = auto()
    LAND = auto()
    SILENCE = auto()
    """Send nothing: the pilot has taken over, or the autopilot's failsafe has to act."""


class Barrier(IntEnum):
    """The meaning of an event while flockd does not fly the drone."""

    NONE = auto()
    WAIT = auto()
    """Not ready while it lasts."""
    LATCH = auto()
    """Not ready until the vehicle was seen disarmed on the ground or an operator asked to resume."""


class Action(StrEnum):
    """What the daemon does now."""

    SILENCE = "silence"
    """Send nothing and request nothing."""
    OFFER = "offer"
    """Send standstill, so that the autopilot lets the pilot switch to offboard; until then it ignores setpoints."""
    FLY = "fly"
    FLY_DEGRADED = "fly_degraded"
    HOVER = "hover"
    """Send standstill. The three actions that request a mode do so too, until it has changed."""
    ASK_HOLD = "ask_hold"
    ASK_RETURN = "ask_return"
    ASK_LAND = "ask_land"


ASKS: Mapping[Reaction, Action] = {
    Reaction.HOLD: Action.ASK_HOLD,
    Reaction.RETURN: Action.ASK_RETURN,
    Reaction.LAND: Action.ASK_LAND,
}


@dataclass(frozen=True)
class Rule:
    """Barrier and reactions of one event."""

    barrier: Barrier
    """Before the flight and after it."""
    reaction: Reaction
    """In flight."""
    after_s: float = math.inf
    later: Reaction = Reaction.HOLD
    """In flight, instead of `reaction`, once the event has lasted `after_s`."""

    def reaction_at(self, lasted_s: float) -> Reaction:
        """The reaction in flight to an event that has lasted this long."""
        return self.later if lasted_s >= self.after_s else self.reaction


ROOM_S = 30.0
"""Time for which a drone with a large velocity error gains distance before it requests Hold."""
FOREIGN_S = 0.5
"""Time for which another sender may interfere before Hold is requested."""


def rules(p: SafetyParameters) -> dict[Event, Rule]:
    """The rule of every event."""
    on_battery_low = Reaction[p.on_battery_low.upper()]
    on_position_lost = Reaction[p.on_position_lost.upper()]
    alone_s = math.inf if p.alone_s is None else p.alone_s
    return {
        Event.SIGHT_LOST: Rule(Barrier.WAIT, Reaction.HOVER),
        Event.CAMERA_LOST: Rule(Barrier.NONE, Reaction.DEGRADE),
        Event.FRAMES_DROPPED: Rule(Barrier.NONE, Reaction.DEGRADE),
        Event.ESTIMATE_STALE: Rule(Barrier.WAIT, Reaction.HOVER),
        Event.EGO_MOTION_POOR: Rule(Barrier.NONE, Reaction.DEGRADE),
        Event.EGO_MOTION_LOST: Rule(Barrier.WAIT, Reaction.HOVER),
        Event.NETWORK_FAULT: Rule(Barrier.NONE, Reaction.DEGRADE),
        Event.INFERENCE_STUCK: Rule(Barrier.NONE, Reaction.DEGRADE),
        Event.OVERLOADED: Rule(Barrier.NONE, Reaction.DEGRADE),
        Event.FAR_OVERLOADED: Rule(Barrier.WAIT, Reaction.HOVER),
        Event.HOT: Rule(Barrier.NONE, Reaction.DEGRADE),
        Event.TOO_HOT: Rule(Barrier.WAIT, Reaction.HOVER),
        Event.LOOP_LATE: Rule(Barrier.NONE, Reaction.DEGRADE),
        Event.VELOCITY_OFF: Rule(Barrier.NONE, Reaction.DEGRADE),
        Event.VELOCITY_FAR_OFF: Rule(Barrier.NONE, Reaction.HOLD),
        Event.NO_ROOM_TO_HOLD: Rule(Barrier.NONE, Reaction.DEGRADE, ROOM_S, Reaction.HOLD),
        Event.TASK_DIED: Rule(Barrier.WAIT, Reaction.HOLD),
        Event.NEIGHBOURS_LOST: Rule(Barrier.NONE, Reaction.NOTE, alone_s, Reaction.HOLD),
        Event.NEIGHBOUR_CLOSE: Rule(Barrier.NONE, Reaction.NOTE),
        Event.COMMAND_REFUSED: Rule(Barrier.NONE, Reaction.DEGRADE),
        Event.FENCE_LEFT: Rule(Barrier.WAIT, Reaction.DEGRADE, p.outside_s, Reaction.HOLD),
        Event.HEIGHTS_LEFT: Rule(Barrier.WAIT, Reaction.DEGRADE, p.outside_s, Reaction.HOLD),
        Event.MOTION_UNKNOWN: Rule(Barrier.WAIT, Reaction.HOVER),
        Event.LINK_LOST: Rule(Barrier.LATCH, Reaction.SILENCE),
        Event.STREAM_ENDED: Rule(Barrier.LATCH, Reaction.SILENCE),
        Event.AUTOPILOT_FAILSAFE: Rule(Barrier.WAIT, Reaction.NOTE),
        Event.FOREIGN_SETPOINTS: Rule(Barrier.NONE, Reaction.DEGRADE, FOREIGN_S, Reaction.HOLD),
        Event.PARAMETERS_UNSUITABLE: Rule(Barrier.WAIT, Reaction.DEGRADE, FOREIGN_S, Reaction.HOLD),
        Event.FRAME_JUMPED: Rule(Barrier.NONE, Reaction.HOLD),
        Event.NOT_OFFBOARD: Rule(Barrier.NONE, Reaction.SILENCE),
        Event.NOT_ARMED: Rule(Barrier.WAIT, Reaction.SILENCE),
        Event.NOT_IN_AIR: Rule(Barrier.WAIT, Reaction.NOTE),
        Event.BATTERY_LOW: Rule(Barrier.WAIT, on_battery_low),
        Event.POSITION_LOST: Rule(Barrier.WAIT, on_position_lost),
        Event.SHUTDOWN_ASKED: Rule(Barrier.LATCH, Reaction.HOLD),
        Event.HOLD_ASKED: Rule(Barrier.LATCH, Reaction.HOLD),
        Event.LAND_ASKED: Rule(Barrier.LATCH, Reaction.LAND),
        Event.MISSION_LANDS: Rule(Barrier.NONE, Reaction.LAND),
        Event.MISSION_RETURNS: Rule(Barrier.NONE, Reaction.RETURN),
    }

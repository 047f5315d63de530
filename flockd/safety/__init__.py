"""Whether the drone may be flown, and what may be sent: a supervisor and a last gate, without clock or I/O."""

from __future__ import annotations

from flockd.config.safety import GateParameters, SafetyParameters
from flockd.safety.events import OFFBOARD, CameraHealth, Event, Inputs, MissionEnd
from flockd.safety.fence import outside_fence, outside_heights
from flockd.safety.gate import (
    Gate,
    Objection,
    Permission,
    Surroundings,
    Verdict,
    Wanted,
)
from flockd.safety.policy import Action, Reaction
from flockd.safety.supervisor import Decision, Reason, State, Supervisor

__all__ = [
    "OFFBOARD",
    "Action",
    "CameraHealth",
    "Decision",
    "Event",
    "Gate",
    "GateParameters",
    "Inputs",
    "MissionEnd",
    "Objection",
    "Permission",
    "Reaction",
    "Reason",
    "SafetyParameters",
    "State",
    "Supervisor",
    "Surroundings",
    "Verdict",
    "Wanted",
    "outside_fence",
    "outside_heights",
]

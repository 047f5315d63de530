"""Whether the drone may fly, and which setpoints may be sent: a supervisor and a gate, without clock or I/O."""

from __future__ import annotations

from flockd.flight.safety.events import OFFBOARD, CameraHealth, Event, Inputs, link_lost
from flockd.flight.safety.fence import outside_fence, outside_heights
from flockd.flight.safety.gate import Gate
from flockd.flight.safety.policy import Action
from flockd.flight.safety.request import Objection, Permission, Request, Surroundings, Verdict
from flockd.flight.safety.supervisor import FLYING, Decision, State, Supervisor

__all__ = [
    "FLYING",
    "OFFBOARD",
    "Action",
    "CameraHealth",
    "Decision",
    "Event",
    "Gate",
    "Inputs",
    "Objection",
    "Permission",
    "Request",
    "State",
    "Supervisor",
    "Surroundings",
    "Verdict",
    "link_lost",
    "outside_fence",
    "outside_heights",
]

"""Operators' orders to the drone's mission: refused where they cannot be flown, else handed to the pilot."""

from __future__ import annotations

from collections.abc import Callable

from flockd.core.config import DroneConfig
from flockd.core.messages import MissionOrder, VehicleState
from flockd.flight.mission import order_fault
from flockd.flight.safety import State
from flockd.onboard.daemon.pilot_loop import PilotLoop

_TAKES_ORDERS = frozenset({State.NORMAL, State.DEGRADED, State.HOVER})


class MissionOrders:
    """See `flockd.onboard.daemon.operator_commands.Missions`."""

    def __init__(
        self,
        config: DroneConfig,
        pilot_loop: PilotLoop,
        vehicle: Callable[[], VehicleState | None],
        state: Callable[[], State],
    ) -> None:
        """``vehicle``: its newest state; ``state``: the supervisor's. Both may be called on any thread."""
        self._config, self._pilot_loop, self._vehicle, self._state = config, pilot_loop, vehicle, state

    def fault(self, order: MissionOrder) -> str | None:
        """Why it is refused, one sentence; None: it is not."""
        state = self._state()
        if state not in _TAKES_ORDERS:
            return f"flockd does not fly the drone now, as its state is {state}; its mission begins with the flight"
        return order_fault(self._config, order, self._vehicle())

    def apply(self, order: MissionOrder) -> None:
        """Has the pilot take it in its next step."""
        self._pilot_loop.order = order

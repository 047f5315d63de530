"""The autopilot's parameters that flockd relies on in flight: what they are, and what a change of them means; pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping

LOSS_TIME, LOSS_ACTION, GROUND_STATION_LOSS = "COM_OF_LOSS_T", "COM_OBL_RC_ACT", "NAV_DLL_ACT"
MOST_SPEED = "MPC_XY_VEL_MAX"
KINDS: Mapping[str, type[int] | type[float]] = {
    GROUND_STATION_LOSS: int, LOSS_TIME: float, LOSS_ACTION: int, MOST_SPEED: float
}  # fmt: skip
"""As PX4 declares them."""
LONGEST_LOSS_S = 1.0
"""PX4 flies on with the last velocity for as long as COM_OF_LOSS_T."""
SAFE_ACTIONS: Mapping[int, str] = {0: "Position", 3: "Return", 4: "Land", 5: "Hold"}
"""Values of COM_OBL_RC_ACT with which the autopilot stays where it is, lands or returns."""


class WatchedParameters:
    """The newest values, and what is wrong with those that were changed while the autopilot was armed."""

    def __init__(self, report: Callable[[str], None]) -> None:
        """``report`` is called with one sentence on each change in flight."""
        self._report = report
        self.values: dict[str, float] = {}
        self._before: dict[str, float] = {}
        """As they were while it was disarmed, or when they were read first."""

    def take(self, name: str, value: float, *, armed: bool) -> None:
        """Takes a value that was read."""
        known = self.values.get(name, value)
        self.values[name] = value
        if not armed or name not in self._before:
            self._before[name] = value
        if armed and value != known:
            self._report(f"the autopilot's {name} was changed in flight from {known:g} to {value:g}")

    def fault(self, max_gap_s: float) -> str | None:
        """What is wrong with a change in flight; None: nothing. ``max_gap_s``: of setpoints, that flockd bridges."""
        for name, value in list(self.values.items()):
            if value == self._before.get(name, value):
                continue
            changed = f"{name} was changed in flight from {self._before[name]:g} to {value:g}"
            if name == LOSS_TIME and not max_gap_s < value <= LONGEST_LOSS_S:
                return f"{changed}: the autopilot's failsafe would act that long after the last setpoint"
            if name == LOSS_ACTION and value not in SAFE_ACTIONS:
                return f"{changed}: the autopilot would not stop the drone when setpoints stop"
        return None

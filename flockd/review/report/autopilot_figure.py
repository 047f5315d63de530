"""The report's part about the autopilot's own log: commanded, followed, flown; modes and failsafes."""

from __future__ import annotations

from typing import Any, Final

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from flockd.review.flight_log.autopilot_log import AutopilotLog
from flockd.review.flight_log.log import FlightLog
from flockd.review.flight_log.velocity_response import velocity_response
from flockd.review.report.style import DRONE_COLOURS, INK, MUTED, STYLE, drone_name

FLOWN, COMMANDED, FAILSAFE = DRONE_COLOURS[0], DRONE_COLOURS[1], "#c0392b"
MODE_COLOURS: Final = {"offboard": DRONE_COLOURS[2]}
"""Colours of modes that stand out; all others are grey."""
MOST_ROWS = 60
"""The most rows of the table: a log that warns without end does not fill the page."""


def autopilot_figure(log: FlightLog, autopilot: AutopilotLog) -> Figure:
    """Velocity north and east and height, and the flight modes below, over the flight's time."""
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 7.2), layout="constrained")
        panels = figure.subplots(4, 1, sharex=True, height_ratios=(3, 3, 3, 1))
        command = log.command_velocity[:, autopilot.drone]
        for axis, name in enumerate(("north", "east")):
            axes = panels[axis]
            axes.plot(log.time_s, command[:, axis], color=COMMANDED, drawstyle="steps-post")
            axes.plot(autopilot.flown_time_s, autopilot.flown_velocity[:, axis], color=FLOWN, linewidth=0.9)
            setpoint = autopilot.setpoint_velocity[:, axis]
            axes.plot(autopilot.setpoint_time_s, setpoint, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
            axes.set_ylabel(f"{name}, m/s")
        height, modes = panels[2:]
        height.plot(autopilot.flown_time_s, autopilot.flown_height_m, color=FLOWN, linewidth=0.9)
        setpoint = autopilot.setpoint_height_m
        height.plot(autopilot.setpoint_time_s, setpoint, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
        height.set_ylabel("height, m")
        _mode_band(modes, autopilot)
        modes.set_xlabel("time, s")
        for axes in panels:
            for span in autopilot.failsafes:
                axes.axvspan(span.begin_s, span.end_s, color=FAILSAFE, alpha=0.18, linewidth=0)
        figure.align_ylabels(panels)
        figure.legend(handles=_handles(autopilot), loc="outside upper left", ncols=4)
    return figure


def _mode_band(axes: Axes, autopilot: AutopilotLog) -> None:
    """A bar for each mode, with its name where there is room."""
    begin_s, end_s = autopilot.flown_time_s[[0, -1]]
    for span in autopilot.modes:
        width_s = span.end_s - span.begin_s
        colour = MODE_COLOURS.get(span.what, MUTED)
        axes.barh(0.0, width_s, left=span.begin_s, color=colour, alpha=0.55, edgecolor="none")
        if width_s > 0.05 * (end_s - begin_s):
            axes.text(span.begin_s + 0.5 * width_s, 0.0, span.what, ha="center", va="center", fontsize=8)
    axes.set_yticks([])
    axes.set_ylabel("mode")
    axes.grid(visible=False)


def _handles(autopilot: AutopilotLog) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=COMMANDED, label="commanded by flockd"),
        Line2D([], [], color=INK, linestyle=(0, (4, 3)), label="setpoint in the autopilot"),
        Line2D([], [], color=FLOWN, label="flown, as the autopilot estimates"),
    ]
    return handles + [Patch(color=FAILSAFE, alpha=0.18, label="failsafe")] * bool(autopilot.failsafes)


def autopilot_texts(log: FlightLog, autopilot: AutopilotLog | None) -> dict[str, Any]:
    """The texts and table cells of the part, by their name in the page's template; none without such a log."""
    if autopilot is None:
        return {}
    names = log.metadata.names
    spans = [(span.begin_s, f"{span.end_s:.1f}", span.what) for span in (*autopilot.modes, *autopilot.failsafes)]
    rows = sorted([*spans, *((said.time_s, "", said.text) for said in autopilot.said)])
    more = len(rows) - MOST_ROWS
    cells = [{"begin": f"{begin_s:.1f}", "end": end, "what": what} for begin_s, end, what in rows[:MOST_ROWS]]
    return {
        "autopilot_drone": drone_name(autopilot.drone) if names is None else names[autopilot.drone],
        "autopilot_source": autopilot.source,
        "autopilot_placed_by": autopilot.placed_by,
        "autopilot_response": _response_text(autopilot),
        "autopilot_rows": cells + [{"begin": "", "end": "", "what": f"and {more} more"}] * (more > 0),
    }


def _response_text(autopilot: AutopilotLog) -> str:
    fitted = velocity_response(autopilot)
    if fitted is None:
        return "Its setpoints changed too little, or for too short a time, to fit its response."
    return (
        f"The velocity followed its setpoints with a time constant of {fitted.time_constant_s:.2f} s after a dead time "
        f"of {fitted.dead_time_s:.2f} s (root mean square error {fitted.error_m_s:.2f} m/s): set "
        "safety.gate.response_s to the time constant, and reaction_s and neighbour_reaction_s to no less than both "
        "together."
    )

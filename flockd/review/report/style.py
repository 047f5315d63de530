"""How figures of the report are drawn: fonts and colours, one colour a drone."""

from __future__ import annotations

from typing import Any, Final

from matplotlib import colormaps
from matplotlib.colors import to_hex

FEW: Final = 8
"""Up to this many drones have a line and a colour each; more are shown as the band they fill."""

NAMED: Final = 12
"""Up to this many have their number and their distances written into the formation."""

INK: Final = "#1b2430"
MUTED: Final = "#667382"
GRID: Final = "#dde3ea"
PAPER: Final = "#ffffff"

# Okabe and Ito's colours, which colour-blind readers can tell apart; yellow darkened and black made grey, so that all
# eight can be seen on white and on near-black.
DRONE_COLOURS: Final = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#a39400", "#808890")

BAND: Final = DRONE_COLOURS[0]
"""Colour of the band that many drones fill."""

ON_COLOUR: Final = "#fffffe"
"""White in either scheme, so not the paper's."""

STYLE: Final[dict[Any, Any]] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.labelsize": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": PAPER,
    "figure.dpi": 150.0,
    "svg.fonttype": "none",
    "svg.image_inline": True,
}


def colour_of(number: int, count: int) -> str:
    """The colour of drone `number` (from 0) in a flock of `count`."""
    if count <= FEW:
        return DRONE_COLOURS[number % FEW]
    return to_hex(colormaps["viridis"](0.2 + 0.65 * number / (count - 1)))


def drone_name(number: int) -> str:
    """Drones count from 0 in the log and from 1 in the report, as in the paper."""
    return f"drone {number + 1}"

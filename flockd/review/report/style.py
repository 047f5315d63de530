"""How figures of the report are drawn: fonts and colours, one colour a drone."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any, Final

import jinja2
from matplotlib import colormaps, rc_context
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

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


def drone_handles(drones: int) -> list[Line2D]:
    """Legend entries, a line for each drone. Drones count from 0 in the log, and from 1 in the report and the paper."""
    return [Line2D([], [], color=colour_of(i, drones), label=f"drone {i + 1}") for i in range(drones)]


# What the page's style sheet turns with the reader's light or dark scheme.
_THEMED: Final = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    GRID: "var(--grid)",
    PAPER: "var(--paper)",
    BAND: "var(--blue)",
}


def page_template(path: Path) -> jinja2.Template:
    """The page at a path, which may include `page.css`. What is filled in is escaped, and nothing may be missing."""
    loader = jinja2.FileSystemLoader([path.parent, Path(__file__).parent])
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(path.name)


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """The figure as an `<svg>` element for a page that sets --ink, --muted, --grid, --paper, --blue and --sans.

    `name` keeps its ids apart from those of other figures in the same page; `description` is its accessible name.
    """
    buffer = io.StringIO()
    with rc_context({**STYLE, "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    text = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in used else "", text)
    text = re.sub(r' width="[\d.]+pt" height="[\d.]+pt"', "", text, count=1)
    text = re.sub(r' xmlns(:xlink)?="[^"]*"', "", text)
    text = text.replace("xlink:href=", "href=").replace("<svg", f'<svg role="img" aria-label="{description}"', 1)
    text = re.sub(r"font: ((?:bold )?[\d.]+px) [^;\"]*", r"font: \1 var(--sans)", text)
    for colour, variable in _THEMED.items():
        text = text.replace(colour, variable)
    return re.sub(r"\n\s*", "\n", text).strip()

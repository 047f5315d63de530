"""What pages are made of: their template, and SVG elements that follow the reader's colour scheme."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Final

import jinja2
from matplotlib import rc_context
from matplotlib.figure import Figure

from flockd.review.report.style import BAND, GRID, INK, MUTED, PAPER, STYLE

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

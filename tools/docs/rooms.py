"""Draws the rooms of flockd and what each imports, from the code: docs/pictures/rooms.svg.

Written by `tools.docs.docs_reference`, with the reference pages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.test_layers import FLIGHT, MODULES, PACKAGE, ROOMS, taken

PICTURE = Path(__file__).parents[2] / "docs" / "pictures" / "rooms.svg"
PURPOSES: Mapping[str, str] = {
    "cli": "what people type",
    "campaign": "many flights",
    "sim": "a world to fly in",
    "review": "replay, report",
    "ground": "calibration, doctor",
    "fleet": "page, orders, ROS 2",
    "onboard": "devices, threads",
    "flight": "pure functions",
    "core": "messages, settings",
    "pilot": "FlockPilot.step",
    "mission": "desired velocity",
    "obstacles": "map, way around",
    "flocking": "the law, passing",
    "safety": "supervisor, gate",
    "perception": "drones, flow, depth",
    "tracking": "neighbours over time",
    "inference": "networks, manifests",
    "geometry": "cameras, own motion",
}
_ROW, _COLUMN, _BOX, _TOP = 36, 23, 262, 78
_WIDTH, _HEIGHT = 1050, 412
_STYLE = (
    "text{fill:#1b2430}.n{font-weight:bold}.s{fill:#4a5665;font-size:13px}.b{fill:#eef4fa;stroke:#0072b2}"
    ".d{fill:#ecf7f2;stroke:#009e73}.o{fill:#d55e00}.x{fill:none;stroke:#c3cbd5}"
)


def picture() -> str:
    """The SVG: two lists from top to bottom, and a dot for each pair of which the upper imports the lower."""
    rooms: dict[str, set[str]] = {room: set() for room in ROOMS}
    folders: dict[str, set[str]] = {folder: set() for folder in FLIGHT}
    for path in MODULES:
        room, *inside = path.relative_to(PACKAGE).parts
        for names in taken(path):
            rooms[room].add(names[0])
            if room == names[0] == "flight" and len(names) > 1 and inside[0] in folders:
                folders[inside[0]].add(names[1])
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}"'
            ' font-family="Helvetica, Arial, sans-serif" font-size="16">',
            "  <title>The rooms of flockd, the folders of flight, and what each imports</title>",
            f"  <style>{_STYLE}</style>",
            f'  <rect width="{_WIDTH}" height="{_HEIGHT}" rx="10" fill="#ffffff"/>',
            *_list("flockd/", tuple(reversed(ROOMS)), rooms, 12, ("onboard", "flight", "core")),
            *_list("flockd/flight/", tuple(reversed(FLIGHT)), folders, 535, FLIGHT),
            "</svg>\n",
        ]
    )


def _list(title: str, order: Sequence[str], uses: Mapping[str, set[str]], left: int, flies: Sequence[str]) -> list[str]:
    """One list, with its dots to the right; `flies`: those that a drone runs."""
    lines = [f'  <text class="n" x="{left}" y="24">{title}</text>']
    for row, name in enumerate(order):
        y, middle = _TOP + row * _ROW, _TOP + row * _ROW + _ROW // 2 - 3
        kind = "d" if name in flies else "b"
        lines.append(f'  <rect class="{kind}" x="{left}" y="{y}" width="{_BOX}" height="{_ROW - 6}" rx="6"/>')
        lines.append(f'  <text class="n" x="{left + 8}" y="{middle + 5}">{name}</text>')
        lines.append(f'  <text class="s" x="{left + 112}" y="{middle + 4}">{PURPOSES[name]}</text>')
        for column, other in enumerate(order):
            x = left + _BOX + 16 + column * _COLUMN
            if row == 0:
                label = f'x="{x}" y="{_TOP - 4}" transform="rotate(-50 {x} {_TOP - 4})"'
                lines.append(f'  <text class="s" {label}>{other}</text>')
            if other in uses[name] and other != name:
                lines.append(f'  <circle class="o" cx="{x}" cy="{middle}" r="5.5"/>')
            elif row < column:
                lines.append(f'  <circle class="x" cx="{x}" cy="{middle}" r="3"/>')
    return lines

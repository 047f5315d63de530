"""The flight report: one self-contained page, and its figures as files, from a flight's folder."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from flockd.core.data import written_whole
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.curves import account_curves, error_curves, flight_curves
from flockd.review.report.filmstrip import Plate
from flockd.review.report.page_texts import page_texts
from flockd.review.report.style import colour_of, inline_svg, page_template
from flockd.review.report.trajectories import in_the_way, obstacle_figure, trajectories

Drawing = tuple[Callable[[FlightLog], Figure | None], str, str]
DRAWINGS_OF_TRUTH: dict[str, Drawing] = {
    "trajectories": (trajectories, "trajectories", "Paths and formation from above"),
    "obstacles": (obstacle_figure, "obstacles", "Clearance over time"),
    "curves": (flight_curves, "curves", "Airspeed, course, heights, distances and deviations over time"),
    "errors": (error_curves, "errors", "Errors of the estimates over time"),
}
"""By their name in the template: the figure's function, its file's name, and what it shows."""
DRAWINGS_OF_ACCOUNT: dict[str, Drawing] = {
    "curves": (account_curves, "account", "Airspeed, course and distances over time, as the drone knew them"),
}
_MAX_SVG_BYTES = 700_000
"""Long flights of many drones make SVG elements larger than the PNG file."""


def write_report(
    directory: Path,
    log: FlightLog,
    summary: Mapping[str, Any],
    plates: Sequence[Plate],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Writes `report.html` and the files of `figures/` into a flight's folder and returns the page's path.

    ``summary`` is `summarise`'s of the log.
    """
    folder = directory / "figures"
    folder.mkdir(exist_ok=True)
    for old in (*folder.glob("*.png"), *folder.glob("*.webp")):
        old.unlink()
    drawings = DRAWINGS_OF_TRUTH if log.has_truth else DRAWINGS_OF_ACCOUNT
    progress(0, len(drawings))
    embedded: dict[str, Markup | None] = dict.fromkeys(DRAWINGS_OF_TRUTH)
    for done, (name, (draw, file, what)) in enumerate(drawings.items(), 1):
        embedded[name] = _embed(draw(log), folder / f"{file}.png", what)
        progress(done, len(drawings))
    for number, plate in enumerate(plates, 1):
        if plate.drone == plates[0].drone:  # as files only the first drone's
            (folder / f"filmstrip_{number}.webp").write_bytes(plate.webp)
    page = page_template(Path(__file__).with_name("report.html")).render(
        **page_texts(summary, log),
        figures=embedded,
        filmstrip=[{**vars(plate), "source": _data_url("image/webp", plate.webp)} for plate in plates],
        plated=list(dict.fromkeys(plate.drone for plate in plates)),
        player=Markup(_flight_data(log)) if log.has_truth else None,
        script=Markup((Path(__file__).parent / "report.js").read_text(encoding="utf-8")),
    )
    path = directory / "report.html"
    with written_whole(path) as draft:
        draft.write_text(page, encoding="utf-8")
    return path


def _flight_data(log: FlightLog) -> str:
    """What the page plays: times, and of each drone metres north, east and up, to the centimetre; the obstacles
    as in the log, and whether they are in the way."""
    drones = log.position.shape[1]
    data = {
        "time": np.round(log.time_s, 3).tolist(),
        "position": (np.round(log.position * (1.0, 1.0, -1.0), 2) + 0.0).tolist(),
        "colours": [colour_of(number, drones) for number in range(drones)],
        "obstacles": [
            [*np.round(row[:5], 3).tolist(), bool(near)]
            for row, near in zip(log.obstacles, in_the_way(log), strict=True)
        ],
    }
    return json.dumps(data, separators=(",", ":"))


def _embed(figure: Figure | None, path: Path, description: str) -> Markup | None:
    """A figure as SVG, or as PNG if that is less; also as a PNG file."""
    if figure is None:
        return None
    element = inline_svg(figure, path.stem, description)
    figure.set_layout_engine("none")  # everything has its place now, and finding it again takes as long as drawing
    image = io.BytesIO()
    figure.savefig(image, format="png")
    path.write_bytes(image.getvalue())
    if len(element) > _MAX_SVG_BYTES:
        element = f'<img src="{_data_url("image/png", image.getvalue())}" alt="{description}">'
    return Markup(f'<div class="drawing">{element}</div>')  # drawn here, from numbers


def _data_url(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"

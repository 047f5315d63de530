"""The flight report: one self-contained page, and its figures as files, from a flight's folder."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from flockd.core.messages import UInt8Array
from flockd.core.side_process import SideProcess, shared
from flockd.review.flight_log.key_frames import KeyFrame, load_key_frames
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.curves import account_curves, error_curves, flight_curves
from flockd.review.report.figure_files import inline_svg
from flockd.review.report.filmstrip import filmstrip_figure
from flockd.review.report.obstacle_figures import in_the_way, obstacle_figure
from flockd.review.report.page_texts import page_texts
from flockd.review.report.style import colour_of
from flockd.review.report.templates import page_template
from flockd.review.report.trajectories import trajectories


def write_report(
    directory: Path, progress: Callable[[int, int], None] = lambda done, total: None, processes: int = 1
) -> Path:
    """Write `report.html` and `figures/*.png` into a flight's folder and return the page's path.

    The folder holds `flight.npz` (FlightLog) and `summary.json` (of `summarise`); if key frames were kept
    `filmstrip.npz`. Figures are drawn in as many ``processes``, of which this is one. Raises
    FileNotFoundError if one of the first two is missing.
    """
    for name in ("flight.npz", "summary.json"):
        if not (directory / name).is_file():
            raise FileNotFoundError(f"{directory / name} is missing: a report is written from the folder of a flight")
    log = FlightLog.load(directory / "flight.npz")
    summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    strip = directory / "filmstrip.npz"
    frames = [frame for frame in load_key_frames(strip) if frame.cameras] if strip.is_file() else []

    folder = directory / "figures"
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.png"):
        old.unlink()
    drawings = _DRAWINGS_OF_TRUTH if log.has_truth else _DRAWINGS_OF_ACCOUNT
    # As files only the first drone's: 1.4 MB each.
    files = [folder / f"filmstrip_{number}.png" for number in range(1, len(frames) + 1)]
    strips = [
        (frame, file if frame.drone == frames[0].drone else None) for frame, file in zip(frames, files, strict=True)
    ]
    draw = _Drawings(log, folder)
    with ExitStack() as stack:
        helpers = [
            stack.enter_context(SideProcess("drew figures", _Drawings, log, folder)) for _ in range(1, processes)
        ]
        drawn = shared([*((name, None) for name in drawings), *strips], draw, helpers, progress)
    embedded: dict[str, Markup | None] = {"trajectories": None, "obstacles": None, "errors": None}
    embedded |= zip(drawings, drawn, strict=False)
    plates = drawn[len(drawings) :]
    page = page_template(Path(__file__).with_name("report.html")).render(
        **page_texts(summary, log),
        **embedded,
        filmstrip=plates,
        plated=list(dict.fromkeys(plate["drone"] for plate in plates)),
        player=Markup(_flight_data(log)) if log.has_truth else None,
        script=Markup((Path(__file__).parent / "report.js").read_text(encoding="utf-8")),
    )
    path = directory / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


_Draw = Callable[..., Figure | None]
_DRAWINGS_OF_TRUTH: dict[str, tuple[_Draw, str, str]] = {
    "trajectories": (trajectories, "trajectories", "Paths and formation from above"),
    "obstacles": (obstacle_figure, "obstacles", "Clearance over time, and what a drone knew of the obstacles"),
    "curves": (flight_curves, "curves", "Airspeed, course, heights, distances and deviations over time"),
    "errors": (error_curves, "errors", "Errors of the estimates over time"),
}
"""By their name in the template: the figure's function, its file's name, and what it shows."""
_DRAWINGS_OF_ACCOUNT: dict[str, tuple[_Draw, str, str]] = {
    "curves": (
        account_curves,
        "account",
        "Airspeed, course and distances of neighbours over time, as the drone knew them",
    ),
}


def _flight_data(log: FlightLog) -> str:
    """What the page plays: times, and of each drone metres north, east and up, to the centimetre; the obstacles
    as in the log, and whether they are in the way."""
    drones = log.position.shape[1]
    up = log.position * (1.0, 1.0, -1.0)
    data = {
        "time": np.round(log.time_s, 3).tolist(),
        "position": (np.round(up, 2) + 0.0).tolist(),
        "colours": [colour_of(number, drones) for number in range(drones)],
        "names": [f"{number + 1}" for number in range(drones)],
        "obstacles": [
            [*np.round(row[:5], 3).tolist(), bool(near)]
            for row, near in zip(log.obstacles, in_the_way(log), strict=True)
        ],
    }
    return json.dumps(data, separators=(",", ":"))


_MAX_SVG_BYTES = 700_000
"""Long flights of many drones make SVG elements larger than the PNG file."""


class _Drawings:
    """Draws what it is asked for."""

    def __init__(self, log: FlightLog, folder: Path) -> None:
        """PNG files go to the folder."""
        self._log, self._folder = log, folder

    def __call__(self, what: str | KeyFrame, file: Path | None) -> Markup | dict[str, Any] | None:
        """A figure by its name, or a key frame's plate with a file or without."""
        if isinstance(what, KeyFrame):
            return _plate(what, file)
        drawings = _DRAWINGS_OF_TRUTH if self._log.has_truth else _DRAWINGS_OF_ACCOUNT
        draw, name, description = drawings[what]
        return _embed(self._log, draw, self._folder / f"{name}.png", description)


def _embed(log: FlightLog, draw: _Draw, path: Path, description: str) -> Markup | None:
    """A drawing as SVG, or as PNG if that is less; also as a PNG file."""
    figure = draw(log)
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


def _plate(frame: KeyFrame, file: Path | None) -> dict[str, Any]:
    """The filmstrip's figure as a PNG file and, for the page, as WebP, a sixth of the size."""
    canvas = FigureCanvasAgg(filmstrip_figure(frame))
    canvas.draw()  # type: ignore[no-untyped-call]
    image: UInt8Array = np.asarray(canvas.buffer_rgba())[..., 2::-1]  # type: ignore[no-untyped-call]
    if file is not None:
        file.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    small = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 82])[1].tobytes()
    return {
        "drone": frame.title,
        "time_s": f"{frame.time_s:.3f}",
        "source": _data_url("image/webp", small),
        "width": image.shape[1],
        "height": image.shape[0],
        "text": f"Images, depth and flow of {frame.title} at {frame.time_s:.1f} s",
    }


def _data_url(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"

"""The flight report: one self-contained page, and its figures as files, from a flight's folder."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from flockd.flight_log.key_frames import KeyFrame, load_key_frames
from flockd.flight_log.log import FlightLog
from flockd.messages import UInt8Array
from flockd.report.curves import account_curves, error_curves, flight_curves
from flockd.report.figure_files import inline_svg, save_png
from flockd.report.filmstrip import filmstrip_figure
from flockd.report.page_texts import page_texts
from flockd.report.trajectories import trajectories


def write_report(directory: Path) -> Path:
    """Write `report.html` and `figures/*.png` into a flight's folder and return the page's path.

    The folder holds `flight.npz` (FlightLog), `summary.json` (of `summarise`) and, if key frames were kept,
    `filmstrip.npz`. Raises FileNotFoundError if one of the first two is missing.
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
    errors = error_curves(log)
    for old in folder.glob("*.png"):
        old.unlink()
    page = _template().render(
        **page_texts(summary, log),
        **(_of_truth(log, folder) if log.has_truth else _of_account(log, folder)),
        errors=_embed(errors, folder, "errors", "Errors of the estimates over time") if errors else None,
        filmstrip=[_plate(frame, number, folder) for number, frame in enumerate(frames, start=1)],
    )
    path = directory / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _of_truth(log: FlightLog, folder: Path) -> dict[str, Markup | None]:
    return {
        "trajectories": _embed(trajectories(log), folder, "trajectories", "Paths and formation from above"),
        "curves": _embed(flight_curves(log), folder, "curves", "Airspeed, course, distances and deviations over time"),
    }


def _of_account(log: FlightLog, folder: Path) -> dict[str, Markup | None]:
    description = "Airspeed, course and distances of neighbours over time, as the drone knew them"
    return {"trajectories": None, "curves": _embed(account_curves(log), folder, "account", description)}


def _template() -> jinja2.Template:
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("report.html")


_MAX_SVG_BYTES = 700_000
"""Long flights of many drones make SVG elements larger than the PNG file."""


def _embed(figure: Figure, folder: Path, name: str, description: str) -> Markup:
    """Write the figure's PNG; for the page, a drawing that follows the reader's scheme, or that PNG if it is less."""
    path = folder / f"{name}.png"
    save_png(figure, path)
    element = inline_svg(figure, name, description)
    if len(element) > _MAX_SVG_BYTES:
        element = f'<img src="{_data_url("image/png", path.read_bytes())}" alt="{description}">'
    return Markup(element)  # drawn here, from numbers


def _plate(frame: KeyFrame, number: int, folder: Path) -> dict[str, Any]:
    """The filmstrip's figure as a PNG file and, for the page, as WebP, a sixth of the size."""
    canvas = FigureCanvasAgg(filmstrip_figure(frame))
    canvas.draw()  # type: ignore[no-untyped-call]
    image: UInt8Array = np.asarray(canvas.buffer_rgba())[..., 2::-1]  # type: ignore[no-untyped-call]
    (folder / f"filmstrip_{number}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    small = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 82])[1].tobytes()
    return {
        "source": _data_url("image/webp", small),
        "width": image.shape[1],
        "height": image.shape[0],
        "text": f"Images, depth and flow of {frame.title} at {frame.time_s:.1f} s",
    }


def _data_url(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"

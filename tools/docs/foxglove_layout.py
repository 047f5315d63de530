"""Write config/foxglove_layout.json: the layout for Foxglove's app that fits `flockd foxglove`.

python -m tools.docs.foxglove_layout

It shows pictures of drone1's front camera, and plots drone1 to drone8; other names are set in the app.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import foxglove.layouts as fl

from flockd.fleet.foxglove.drone_cameras import frame_of
from flockd.fleet.foxglove.fleet_publisher import FLEET, LOG
from flockd.fleet.foxglove.fleet_scene import COLOURS, MAP, SCENE_TOPICS

LAYOUT = Path(__file__).resolve().parents[2] / "config" / "foxglove_layout.json"
DRONES = tuple(f"drone{number + 1}" for number in range(len(COLOURS)))
CAMERA = frame_of(DRONES[0], "front")
WINDOW_S = 120.0


def layout() -> Any:
    """What the app reads, as JSON has it."""
    plots = [_plot("height_m", "Height, m"), _plot("speed_m_s", "Speed, m/s"), _plot("battery_share", "Battery, share")]
    plots += [_plot("load", "Load, share of a step"), _plot("neighbours", "Neighbours tracked")]
    tabs = fl.TabContainer(tabs=[fl.TabItem(title=str(plot.title).partition(",")[0], content=plot) for plot in plots])
    left = _split("column", (3, _scene()), (2, tabs))
    right = _split("column", (2, _picture()), (2, _table()), (2, _log()))
    return json.loads(fl.Layout(content=_split("row", (3, left), (2, right))).to_json())


def main() -> int:
    """Writes the file."""
    LAYOUT.write_text(json.dumps(layout(), indent=2) + "\n", encoding="utf-8")
    return 0


def _scene() -> fl.ThreeDeePanel:
    ground = fl.BaseRendererGridLayerSettings(frame_id=MAP, size=100, divisions=20, color="#808080", visible=True)
    config = fl.ThreeDeeConfig(
        follow_tf=MAP,
        follow_mode="follow-none",
        camera_state=fl.ThreeDeeCameraState(distance=45.0, perspective=True, phi=50.0, theta_offset=0.0),
        topics={topic: fl.BaseRendererSceneUpdateTopicSettings(visible=True) for topic in SCENE_TOPICS},
        layers={"ground": ground},
    )
    return fl.ThreeDeePanel(config=config, title="Flock")


def _plot(field: str, title: str) -> fl.PlotPanel:
    series = [
        fl.PlotSeries(value=f'{FLEET}.drones[:]{{drone=="{drone}"}}.{field}', label=drone, color=colour, enabled=True)
        for drone, colour in zip(DRONES, COLOURS, strict=True)
    ]
    config = fl.PlotConfig(paths=series, x_axis_val="timestamp", following_view_width=WINDOW_S, show_legend=True)
    return fl.PlotPanel(config=config, title=title)


def _picture() -> fl.ImagePanel:
    mode = fl.ImageModeConfig(
        image_topic=f"/{CAMERA}/image",
        calibration_topic=f"/{CAMERA}/calibration",
        annotations={f"/{CAMERA}/tracks": fl.ImageAnnotationSettings(visible=True)},
    )
    return fl.ImagePanel(config=fl.ImageConfig(image_mode=mode), title="Camera")


def _table() -> fl.TablePanel:
    return fl.TablePanel(config=fl.TableConfig(topic_path=f"{FLEET}.drones"), title="Fleet")


def _log() -> fl.LogPanel:
    return fl.LogPanel(config=fl.LogConfig(topic_to_render=LOG, show_name=True, show_level=True), title="Events")


def _split(direction: Any, *items: tuple[float, Any]) -> fl.SplitContainer:
    return fl.SplitContainer(
        direction=direction, items=[fl.SplitItem(proportion=share, content=content) for share, content in items]
    )


if __name__ == "__main__":
    raise SystemExit(main())

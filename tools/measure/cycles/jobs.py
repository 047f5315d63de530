"""What the card asks Blender's Python to render, as a file between the two. Pure, standard library and numpy alone."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tools.measure.cycles.lens import Lens
from tools.measure.cycles.plan import Moment, Neighbour, Pose, Standing

PROPELLER = 100
"""Added to a drone's id where its turning propellers are seen, which count neither as drone nor as background."""


@dataclass(frozen=True)
class Job:
    """Moments to be seen by rigs of cameras."""

    moments: tuple[Moment, ...]
    rigs: dict[str, tuple[Lens, ...]]
    meshes: str
    """Folder of the airframes' repositories."""
    samples: int
    threads: int


def airframe_file(folder: Path, name: str) -> Path:
    """Where an airframe is kept as it is drawn."""
    return folder / f"airframe_{name.replace(' ', '_')}.npz"


def write_job(job: Job, path: Path) -> None:
    """As JSON."""
    path.write_text(json.dumps(asdict(job)), encoding="utf-8")


def read_job(path: Path) -> Job:
    """What `write_job` wrote."""
    values = json.loads(path.read_text(encoding="utf-8"))
    rigs = {name: tuple(_lens(lens) for lens in lenses) for name, lenses in values["rigs"].items()}
    moments = tuple(_moment(moment) for moment in values["moments"])
    return Job(moments, rigs, values["meshes"], values["samples"], values["threads"])


def _lens(values: dict[str, Any]) -> Lens:
    nested = tuple(tuple(row) for row in values["R_body_camera"])
    tuples = {key: tuple(values[key]) for key in ("size_px", "distortion", "position_m")}
    return Lens(**{**values, **tuples, "R_body_camera": nested})


def _moment(values: dict[str, Any]) -> Moment:
    return Moment(
        **{
            **values,
            "relief": tuple(tuple(wave) for wave in values["relief"]),
            "own": _poses(values["own"]),
            "neighbours": tuple(Neighbour(**{**one, "poses": _poses(one["poses"])}) for one in values["neighbours"]),
            "standing": tuple(
                Standing(**{**one, "north_east": tuple(one["north_east"])}) for one in values["standing"]
            ),
        }
    )


def _poses(values: Any) -> Any:
    return tuple(Pose(tuple(one["position"]), tuple(one["roll_pitch_yaw"])) for one in values)

"""Render drones cut out (RGBA), to be put onto photographs for training a detector and a range network.

python3.11 -m venv VENV
VENV/bin/pip install bpy==5.0.1 trimesh pycollada pillow opencv-python-headless numba scipy pyyaml    # 1 GB
apt-get install libxkbcommon0 libsm6 libxi6 libxxf86vm1 libxfixes3 libgl1                # where bpy misses them
git clone https://github.com/ctu-mrs/mrs_uav_gazebo_simulation MESHES/mrs                # BSD-3-Clause
git clone https://github.com/osrf/subt MESHES/subt                                       # Apache-2.0
git clone https://github.com/ethz-asl/rotors_simulator MESHES/rotors                     # Apache-2.0
VENV/bin/python -m tools.training.render_cutouts OUT --meshes MESHES [--count 5000] [--held-out]

OUT receives PNGs, 320 px wide and high, sRGB with straight alpha, and `index.jsonl` with a line for each: what drone it
is, its size (widest horizontal distance, propeller tip to tip), the range to its middle, the focal length, and boxes.
A run that was stopped goes on where it was. What is drawn follows from the seed alone. With `--held-out`, the airframes
that no network may learn from are rendered, in turn, and no others.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tools.training.cutouts.plan import VIEWS, Scene, View, scene

if TYPE_CHECKING:
    from tools.training.cutouts.drones import Drone
    from tools.training.cutouts.studio import Cutout

INDEX = "index.jsonl"
_LEAST_PX = 60
"""A drone that covers less of the picture, as seen by its longer side, is not kept."""


def main() -> None:
    """Render what OUT lacks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--meshes", type=Path, required=True, metavar="FOLDER", help="the airframes' repositories")
    parser.add_argument("--count", type=int, default=5000, help="cut-outs in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--held-out", action="store_true", help="the airframes that are kept for tests, and no others")
    arguments = parser.parse_args()
    try:
        from tools.training.cutouts.studio import Studio  # noqa: PLC0415  # Blender's Python alone has it
    except ImportError as error:
        sys.exit(f"{error}; run this with a Python that has bpy (see --help)")
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    there = _files_in(out / INDEX)
    studio = Studio(arguments.threads)
    first, done = time.monotonic(), 0
    for number in range(-(-arguments.count // VIEWS)):
        planned = scene(arguments.seed, number, arguments.held_out)
        views = range(min(VIEWS, arguments.count - number * VIEWS))
        missing = [k for k in views if _file(number, k) not in there]
        if not missing:
            continue
        try:
            drone = _drone(arguments.meshes, planned)
        except ValueError as error:
            sys.exit(str(error))
        studio.stand(drone, planned.light, planned.seed)
        for k in missing:
            cutout = studio.take(planned, planned.views[k])
            _keep(out, _file(number, k), cutout, _entry(planned, planned.views[k], drone, cutout))
            done += 1
        if number % 20 == 0:
            print(f"{number * VIEWS}: {(time.monotonic() - first) / done:.2f} s a cut-out", flush=True)


def _file(number: int, view: int) -> str:
    return f"{number:05d}_{view}.png"


def _drone(meshes: Path, planned: Scene) -> Drone:
    from tools.training.cutouts import drones  # noqa: PLC0415  # needs trimesh, as Blender's Python has it

    rng = np.random.Generator(np.random.PCG64([planned.seed, 0]))
    if planned.kind == "real":
        return drones.real_drone(meshes, planned.name, rng)
    if planned.kind == "shell":
        return drones.shell_drone(planned.name, planned.seed)
    return drones.generated(int(rng.integers(1 << 20)), planned.seed, rng)


def _entry(planned: Scene, view: View, drone: Drone, cutout: Cutout) -> dict[str, Any]:
    return {
        "name": drone.name,
        "kind": drone.kind,
        "size_m": round(drone.airframe.size_m, 4),
        "range_m": round(cutout.range_m, 4),
        "focal_px": round(cutout.focal_px, 2),
        "middle_px": [round(value, 2) for value in cutout.middle_px],
        "box_px": cutout.box_px,
        "body_box_px": cutout.body_box_px,
        "held_out": drone.is_held_out,
        "white": drone.is_white,
        "propellers": view.propellers,
        "light": planned.light.kind,
        "elevation_deg": round(float(np.degrees(view.elevation)), 1),
        "exposure": round(view.exposure, 3),
    }


def _keep(out: Path, file: str, cutout: Cutout, entry: dict[str, Any]) -> None:
    """The picture, and only when it is whole its line; a line is one write."""
    import cv2  # noqa: PLC0415  # as above

    unfinished = out / f".{file}"
    left, top, right, bottom = cutout.box_px
    entry["kept"] = max(right - left, bottom - top) >= _LEAST_PX
    whole, png = cv2.imencode(".png", cutout.rgba[..., [2, 1, 0, 3]])
    if not whole:
        raise RuntimeError(f"{file}: the picture could not be encoded")
    unfinished.write_bytes(png.tobytes())
    unfinished.rename(out / file)
    line = json.dumps({"file": file, **entry}) + "\n"
    index = os.open(out / INDEX, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(index, line.encode())
    finally:
        os.close(index)


def _files_in(index: Path) -> set[str]:
    """What is there already; a last line that a crash cut off is taken away."""
    if not index.is_file():
        return set()
    text = index.read_bytes()
    whole = text[: text.rfind(b"\n") + 1]
    if whole != text:
        index.write_bytes(whole)
    return {str(json.loads(line)["file"]) for line in whole.splitlines()}


if __name__ == "__main__":
    main()

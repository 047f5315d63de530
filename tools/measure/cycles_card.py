"""Measure the shipped perception on pictures of Blender's Cycles, a renderer that shares nothing with flockd's own.

python3.11 -m venv VENV && VENV/bin/pip install bpy==5.0.1 trimesh pycollada pillow     # 1 GB, on Python 3.11 alone
git clone https://github.com/ctu-mrs/mrs_uav_gazebo_simulator MESHES/mrs                # BSD-3-Clause
git clone https://github.com/osrf/subt MESHES/subt                                      # Apache-2.0
python -m tools.measure.cycles_card --blender VENV/bin/python --meshes MESHES --keep FOLDER [--moments 20]

Each moment is two frame sets of four cameras, 0.5 s apart, by the pinholes of `config/simulator.yaml` and by the
fisheyes of `config/quadrotor.yaml`. With `--keep`, what was rendered stays, and the next run goes on from there. Beside
Cycles stand the same places drawn by flockd's renderer: with the same real airframes, and with shapes that the networks
learnt from.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flockd.core.config import DroneConfig, load_drone
from flockd.core.config.perception import PerceptionConfig
from flockd.core.data import data_path
from flockd.flight.geometry import build_rig
from flockd.flight.perception import load_networks
from tools.measure.cycles.card import Findings, by_shape, look, rows
from tools.measure.cycles.jobs import Job, read_job, write_job
from tools.measure.cycles.lens import Lens
from tools.measure.cycles.plan import Moment, moment
from tools.measure.cycles.sheet import contact_sheet
from tools.measure.cycles.sources import AIRFRAMES
from tools.measure.cycles.taken import Taken, draw_taken, known_models, read_taken, real_models

LENS_WITHIN_PX = 0.5
"""Cycles shows balls at known places no farther than this from where flockd's camera model has them."""
_NAME, _WIDTH = 41, 13


def main() -> None:
    """Render what is missing, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blender", default=os.environ.get("FLOCKD_BLENDER_PYTHON"), metavar="PYTHON",
                        help="the Python that has bpy; default: $FLOCKD_BLENDER_PYTHON")  # fmt: skip
    parser.add_argument("--meshes", default=os.environ.get("FLOCKD_MESHES"), metavar="FOLDER",
                        help="folder with the airframes' repositories; default: $FLOCKD_MESHES")  # fmt: skip
    parser.add_argument("--moments", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=8, help="of each pixel, before the noise is taken out")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the pictures, and a contact sheet, there")
    parser.add_argument("--detector", default=PerceptionConfig().detector, metavar="NAME", help="a network, or `none`")
    parser.add_argument("--rigs", nargs="+", choices=("pinhole", "fisheye"), default=("pinhole", "fisheye"))
    parser.add_argument("--only-rendered", action="store_true", help="render nothing: measure what FOLDER holds")
    parser.add_argument("--no-own", action="store_true", help="without the pictures of flockd's renderer beside it")
    arguments = parser.parse_args()
    if arguments.only_rendered and not arguments.keep:
        parser.error("--only-rendered measures what a folder holds: name it with --keep")
    configs = {name: config for name, config in drones(arguments.detector).items() if name in arguments.rigs}
    moments = tuple(moment(arguments.seed, k, tuple(AIRFRAMES)) for k in range(arguments.moments))
    with tempfile.TemporaryDirectory() as temporary:
        folder = (arguments.keep or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        _check_same(folder / "job.json", moments)
        if not arguments.only_rendered:
            rigs = {name: lenses_of(config) for name, config in configs.items()}
            _render(Job(moments, rigs, str(arguments.meshes or ""), arguments.samples, arguments.threads),
                    arguments.blender, folder)  # fmt: skip
        if not (folder / "markers.json").is_file():
            sys.exit(f"{folder}: nothing is rendered there")
        off_px = lens_errors_px(folder / "markers.json", configs)
        for name, off in off_px.items():
            print(f"{name}: known places are within {off:.2f} px of where flockd's camera model has them")
            if not off < LENS_WITHIN_PX:
                sys.exit(
                    f"{name}: Cycles's lens is not flockd's: {off:.2f} px apart, and {LENS_WITHIN_PX} px are allowed"
                )
        _print_card(moments, configs, folder, with_own=not arguments.no_own)


def drones(detector: str) -> dict[str, DroneConfig]:
    """The simulator's drone and a detector, with its own pinholes and with a real drone's cameras."""
    pinhole, real = (load_drone(data_path("config") / f"{name}.yaml") for name in ("simulator", "quadrotor"))
    perception = pinhole.perception.model_copy(update={"detector": detector})
    pinhole = pinhole.model_copy(update={"perception": perception})
    return {"pinhole": pinhole, "fisheye": pinhole.model_copy(update={"rig": real.rig})}


def lenses_of(config: DroneConfig) -> tuple[Lens, ...]:
    """The rig's cameras as Blender's Python is told of them."""
    rig = build_rig(config.rig)
    lenses = []
    for camera in config.rig.cameras:
        inner, mounted = camera.intrinsics, rig.cameras[camera.name].T_body_camera
        first, second, third, position = (
            (float(x), float(y), float(z)) for x, y, z in (*mounted.rotation, mounted.translation)
        )
        lenses.append(
            Lens(
                camera.name, inner.model, camera.size_px, inner.fx, inner.fy, inner.cx, inner.cy,
                tuple(inner.distortion), (first, second, third), position,
            )
        )  # fmt: skip
    return tuple(lenses)


def lens_errors_px(markers: Path, configs: dict[str, DroneConfig]) -> dict[str, float]:
    """By rig, the largest distance from where Cycles shows a ball to where flockd's camera model projects it."""
    report: dict[str, Any] = json.loads(markers.read_text(encoding="utf-8"))
    errors = {}
    for name, config in configs.items():
        camera = next(iter(build_rig(config.rig).cameras.values())).camera
        shown, expected = np.array(report[name]["pixels"]), camera.project(np.array(report[name]["places"]))
        errors[name] = float(np.linalg.norm(shown - expected, axis=1).max())
    return errors


def _check_same(path: Path, moments: tuple[Moment, ...]) -> None:
    """A folder holds moments of one seed: those of two would be taken for each other."""
    kept = read_job(path).moments if path.is_file() else ()
    if any(one != other for one, other in zip(kept, moments, strict=False)):
        sys.exit(
            f"{path.parent}: holds other moments, of another seed or another version; name another folder with --keep"
        )


def _render(job: Job, blender: str | None, folder: Path) -> None:
    if blender is None or not Path(blender).is_file():
        sys.exit(
            "Cycles needs a Python 3.11 with bpy==5.0.1, trimesh, pycollada and pillow in an environment of its own: "
            "name it with --blender or FLOCKD_BLENDER_PYTHON (how to make it: --help)"
        )
    if not Path(job.meshes).is_dir() or not job.meshes:
        sys.exit("airframes' meshes are not part of flockd: name their folder with --meshes or FLOCKD_MESHES (--help)")
    path = folder / "job.json"
    write_job(replace(job, meshes=str(Path(job.meshes).absolute())), path)
    # Not resolved: the link is what makes it the environment's Python.
    command = [str(Path(blender).absolute()), "-m", "tools.measure.cycles.render", str(path), str(folder)]
    # Blender prints a line for each tile; what it says of errors goes to the error stream.
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False, cwd=Path(__file__).parents[2])
    if done.returncode:
        sys.exit(f"rendering ended with {done.returncode}: {' '.join(command)}")


def _print_card(moments: tuple[Moment, ...], configs: dict[str, DroneConfig], folder: Path, *, with_own: bool) -> None:
    for name, config in configs.items():
        networks, rig = load_networks(config.perception), build_rig(config.rig)
        there = [one for one in moments if (folder / f"moment_{one.number:03d}_{name}.npz").is_file()]

        def rendered(one: Moment, name: str = name) -> Taken:
            return read_taken(folder / f"moment_{one.number:03d}_{name}.npz", one)

        columns = {}
        if there:
            columns["Cycles"] = look(config, networks, map(rendered, there))
            contact_sheet(columns["Cycles"], there, rendered, rig, folder / f"sheet_{name}.png")
        if with_own:
            real = (
                draw_taken(one, rig, real_models(one, folder), [of.airframe for of in one.neighbours])
                for one in moments
            )
            known = (draw_taken(one, rig, *known_models(one)) for one in moments)
            columns |= {"own, real": look(config, networks, real), "own, known": look(config, networks, known)}
        _print_columns(name, columns)


def _print_columns(rig: str, columns: dict[str, Findings]) -> None:
    print()
    print(f"{rig:{_NAME}s}" + "".join(f"{name:>{_WIDTH}s}" for name in columns))
    figures = {name: dict(rows(found)) for name, found in columns.items()}
    for row in next(iter(figures.values()), {}):
        print(f"{row:{_NAME}s}" + "".join(f"{figures[name][row]:>{_WIDTH}s}" for name in columns))
    for name, found in columns.items():
        print()
        print(
            f"{f'{rig}, {name}, over 12 px':{_NAME}s}"
            + "".join(f"{of:>{_WIDTH}s}" for of in ("found", "bias", "off by"))
        )
        for shape, *shown in by_shape(found):
            licence = f", {AIRFRAMES[shape].licence}" if shape in AIRFRAMES else ""
            print(f"{shape + licence:{_NAME}s}" + "".join(f"{figure:>{_WIDTH}s}" for figure in shown))
        if found.rejected:
            print(f"pictures not used: {len(found.rejected)}, the first as {found.rejected[0]}")


if __name__ == "__main__":
    main()

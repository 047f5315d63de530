"""Real airframes and shells of camera drones as flockd's renderer draws them: their looks and sizes belong together.

    python -m tools.training.airframes MESHES OUT

MESHES as for `tools.training.render_cutouts`; OUT gets one small file an airframe, for `render_drone_crops
--airframes`.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.sim.airframe import DroneModel
from tools.measure.cycles.airframes import Airframe, Rotor, airframe
from tools.measure.cycles.plan import painted
from tools.training.cutouts.drones import propeller, shell_drone, swept
from tools.training.cutouts.shells import KINDS
from tools.training.cutouts.sources import HELD_OUT, SOURCES, TRAINING
from tools.training.own_mesh import model_of, simplified

Array = NDArray[Any]
FIRST_REAL = 30_000
"""Numbers of these shapes are from here up, beyond those of the generator and of a fleet's own drone."""
_TRIANGLES, _CELLS = 12_000, (240, 160, 110, 80)
_LEAST_AREA_M2 = 1e-10
_SHELLS = tuple(KINDS)
_PAINTS, _PAINT_SHARES = ("its own", "white", "dark"), (0.5, 0.3, 0.2)


def main() -> None:
    """Write the airframes, simplified."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in SOURCES:
        shape = airframe(arguments.meshes, name, SOURCES)
        vertices, triangles, colours = shape.vertices, shape.triangles, shape.colours
        for cells in _CELLS:
            if len(triangles) > _TRIANGLES:
                vertices, triangles, kept = simplified(vertices, triangles, shape.size_m / cells)
                colours = colours[kept]
        hubs, radii = np.array([one.hub for one in shape.rotors]), np.array([one.radius_m for one in shape.rotors])
        file = arguments.out / f"{name}.npz"
        np.savez_compressed(
            file, vertices=vertices.astype(np.float32), triangles=triangles.astype(np.int32),
            colours=colours.astype(np.float32), hubs=hubs, radii=radii,
        )  # fmt: skip
        print(f"{file}: {shape.size_m:.2f} m, {len(triangles)} triangles{', held out' * (name in HELD_OUT)}")


def real_models(folder: Path, paints: int, rng: Generator, *, held_out: bool = False) -> list[list[DroneModel]]:
    """Each real airframe and each kind of shell, so often painted; or those airframes that no network learns from."""
    names = HELD_OUT if held_out else TRAINING
    models = [[_of_file(folder, name, rng) for _ in range(paints)] for name in names]
    if not held_out:
        models += [[_of_shell(kind, rng) for _ in range(paints)] for kind in _SHELLS]
    return models


def name_of(family: int) -> str:
    """Of a drone by its number: an airframe's, a shell's, or the number itself."""
    names = (*SOURCES, *_SHELLS)
    return names[family - FIRST_REAL] if family >= FIRST_REAL else f"family {family}"


def _of_file(folder: Path, name: str, rng: Generator) -> DroneModel:
    with np.load(folder / f"{name}.npz") as arrays:
        rotors = tuple(Rotor(hub, float(r)) for hub, r in zip(arrays["hubs"], arrays["radii"], strict=True))
        colours = painted(arrays["colours"].astype(float), str(rng.choice(_PAINTS, p=_PAINT_SHARES)))
        shape = Airframe(arrays["vertices"].astype(float), arrays["triangles"], colours, rotors)
    return _with_propellers(shape, FIRST_REAL + list(SOURCES).index(name), rng)


def _of_shell(kind: str, rng: Generator) -> DroneModel:
    shape = shell_drone(kind, int(rng.integers(1 << 31))).airframe
    return _with_propellers(shape, FIRST_REAL + len(SOURCES) + _SHELLS.index(kind), rng)


def _with_propellers(shape: Airframe, family: int, rng: Generator) -> DroneModel:
    """As blades that stand, or as the sectors that they sweep while a shutter is open."""
    standing, blades = rng.random() < 0.4, int(rng.choice([2, 3], p=[0.8, 0.2]))
    width, colour = rng.uniform(0.3, math.pi), rng.choice([0.03, 0.3, 0.6], p=[0.7, 0.15, 0.15])
    corners, faces, colours = [shape.vertices], [shape.triangles], [shape.colours]
    for k, rotor in enumerate(shape.rotors):
        turn = rng.uniform(0.0, 2.0 * math.pi)
        if standing:
            places, triangles = propeller(rotor.radius_m, turn, blades, 0.0, 1.0 if k % 2 else -1.0)
        else:
            places, triangles = swept(rotor.radius_m, turn, width, blades)
        faces.append(triangles + sum(len(part) for part in corners))
        corners.append(places + rotor.hub)
        colours.append(np.full((len(triangles), 3), colour))
    vertices, triangles = np.vstack(corners), np.vstack(faces)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    has_area = np.linalg.norm(np.cross(b - a, c - a), axis=1) > _LEAST_AREA_M2
    painted_in = np.clip(np.vstack(colours) * np.exp(rng.normal(0, 0.15)), 0.01, 0.9)
    hubs = np.array([rotor.hub for rotor in shape.rotors])
    return model_of(vertices, triangles[has_area], painted_in[has_area], shape.size_m, family=family, hubs=hubs)


if __name__ == "__main__":
    main()

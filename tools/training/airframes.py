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
from tools.measure.cycles.airframes import Airframe, Rotor, airframe, save_airframe
from tools.measure.cycles.jobs import airframe_file
from tools.measure.cycles.plan import painted
from tools.training.cutouts.drones import propeller, shell_drone, swept
from tools.training.cutouts.shells import KINDS
from tools.training.cutouts.sources import HELD_OUT, SOURCES, TRAINING
from tools.training.own_mesh import joined, model_of, simplified

Array = NDArray[Any]
FIRST_REAL = 30_000
"""Numbers of these shapes are from here up, beyond those of the generator and of a fleet's own drone."""
_MOST_TRIANGLES = 12_000
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
        mesh = simplified(shape.vertices, shape.triangles, shape.colours, shape.size_m, _MOST_TRIANGLES)
        file = airframe_file(arguments.out, name)
        save_airframe(Airframe(*mesh, shape.rotors), file)
        print(f"{file}: {shape.size_m:.2f} m, {len(mesh[1])} triangles{', held out' * (name in HELD_OUT)}")


def airframe_models(folder: Path, paints: int, rng: Generator, *, held_out: bool = False) -> list[list[DroneModel]]:
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
    with np.load(airframe_file(folder, name)) as arrays:
        rotors = tuple(Rotor(hub, float(r)) for hub, r in zip(arrays["hubs"], arrays["radii"], strict=True))
        colours = painted(arrays["colours"], str(rng.choice(_PAINTS, p=_PAINT_SHARES)))
        shape = Airframe(arrays["vertices"], arrays["triangles"], colours, rotors)
    return _with_propellers(shape, FIRST_REAL + list(SOURCES).index(name), rng)


def _of_shell(kind: str, rng: Generator) -> DroneModel:
    shape = shell_drone(kind, int(rng.integers(1 << 31))).airframe
    return _with_propellers(shape, FIRST_REAL + len(SOURCES) + _SHELLS.index(kind), rng)


def _with_propellers(shape: Airframe, family: int, rng: Generator) -> DroneModel:
    """As blades that stand, or as the sectors that they sweep while a shutter is open."""
    standing, blades = rng.random() < 0.4, int(rng.choice([2, 3], p=[0.8, 0.2]))
    width, colour = rng.uniform(0.3, math.pi), rng.choice([0.03, 0.3, 0.6], p=[0.7, 0.15, 0.15])
    parts = [(shape.vertices, shape.triangles, shape.colours)]
    for k, rotor in enumerate(shape.rotors):
        turn = rng.uniform(0.0, 2.0 * math.pi)
        if standing:
            places, triangles = propeller(rotor.radius_m, turn, blades, 0.0, 1.0 if k % 2 else -1.0)
        else:
            places, triangles = swept(rotor.radius_m, turn, width, blades)
        parts.append((places + rotor.hub, triangles, np.full((len(triangles), 3), colour)))
    vertices, triangles, colours = joined(parts)
    colours = np.clip(colours * np.exp(rng.normal(0, 0.15)), 0.01, 0.9)
    hubs = np.array([rotor.hub for rotor in shape.rotors])
    return model_of(vertices, triangles, colours, shape.size_m, family=family, hubs=hubs)


if __name__ == "__main__":
    main()

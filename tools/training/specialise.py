"""Fine-tune the second stage for a fleet's own drone, within an hour on two cores; flockd's networks stay as they are.

    python -m tools.training.specialise --mesh MY.glb --size-m 0.55 --out FOLDER
    python -m tools.training.specialise --pictures PICTURES --labels coco.json --out FOLDER

A mesh (glTF, STL or OBJ) is rendered in training worlds, and `distance` learns the drone's shape, hence its range.
From photographs with labelled boxes, as of `flockd detect --labels`, nobody knows a range: `verification` learns how
the drone looks. Writes the network and its 8-bit version with their manifests into FOLDER, and prints what they are
worth on worlds or pictures that they have not seen, before and after. A stopped run goes on where it was: say the same
again. FOLDER/work holds what was rendered, gigabytes, and may be deleted afterwards.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import torch

from flockd.core.errors import FlockdError
from tools.training.own_mesh import UP_AXES, read_meshes
from tools.training.specialising.from_mesh import claim_mesh, specialise_range
from tools.training.specialising.from_pictures import claim_pictures, read_pictures, specialise_verification


def main(command_line: Sequence[str] | None = None) -> None:
    """From a mesh or pictures to networks that a configuration can name."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--mesh",
        type=Path,
        nargs="+",
        help="of the drone, with propellers and its colours (.glb, .gltf, .stl, .obj); several: any of them",
    )
    source.add_argument("--pictures", type=Path, help="photographs of the drone: a folder")
    parser.add_argument("--size-m", type=float, help="of --mesh: widest horizontal distance, propeller tip to tip, m")
    parser.add_argument(
        "--up", choices=UP_AXES, help="the mesh's axis that points up: by default y of glTF, z of others"
    )
    parser.add_argument("--labels", type=Path, help="of --pictures: COCO file with boxes of the category `drone`")
    parser.add_argument("--out", type=Path, required=True, help="folder for the networks")
    parser.add_argument("--minutes", type=float, default=50.0, help="for all of it")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="that render")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="that train")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(command_line)
    if arguments.mesh and arguments.size_m is None:
        parser.error("--mesh needs --size-m, the drone's size: a mesh's unit and a range are nothing without it")
    if arguments.pictures and arguments.labels is None:
        parser.error("--pictures needs --labels, a COCO file that says where the drone is")
    begin = time.monotonic()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(1)
    try:
        if arguments.mesh:
            drones = read_meshes(arguments.mesh, arguments.size_m, arguments.up)
            claim_mesh(arguments)
        else:
            pictures = read_pictures(arguments)
            claim_pictures(arguments, pictures)
    except (ValueError, FlockdError) as error:
        parser.error(str(error))
    if arguments.mesh:
        specialise_range(arguments, drones, begin)
    else:
        specialise_verification(arguments, pictures, begin)


if __name__ == "__main__":
    main()

"""Builds what a stranger installs, and flies it: sdist and wheel, the wheel alone in an empty environment.

python -m tools.release.check_wheel --out dist

CI runs it too (`.ci/run`). It needs a package index, and 1 GB in the folder for temporary files. Exit code 1:
something of it failed, and is named.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path
from typing import NamedTuple

from flockd import __version__
from tools.release.wheels import ROOT

PICTURE = ROOT / "tests/ground/pictures/rendered/4_m_4.jpg"
"""One drone."""


class Step(NamedTuple):
    """A command of the installed package, run in a folder that has nothing else."""

    arguments: tuple[str, ...]
    shows: str = ""
    """What its output has to have."""
    codes: tuple[int, ...] = (0,)
    """Exit codes that are well."""


STEPS = (
    Step(("--version",), f"flockd {__version__}"),
    Step(("models", "verify")),
    Step(("config", "check", "{data}/config/simulator.yaml")),
    Step(("sim", "--perception", "truth", "--duration", "2", "--drones", "3", "--out", "{folder}/flight")),
    Step(("detect", "--fov", "90", "{folder}/picture.jpg"), "detections: 1, images: 1"),
    # It fails a step that is too slow, as it should on a busy computer; of what is installed nothing may be wrong.
    Step(
        ("doctor", "--config", "{data}/config/simulator.yaml"),
        "PASS     model verification_int8  hash and golden output",
        (0, 1),
    ),
)


def main() -> int:
    """Says each step; the first that fails ends it."""
    parser = argparse.ArgumentParser(description="Builds sdist and wheel, checks them, and flies the wheel.")
    parser.add_argument("--out", type=Path, default=Path("dist"), help="for both (default: dist)")
    args = parser.parse_args()
    out = args.out.resolve()
    with tempfile.TemporaryDirectory(prefix="flockd-release-") as name:
        folder = Path(name)
        tools, alone = folder / "tools", folder / "alone"
        for environment in (tools, alone):
            venv.create(environment, with_pip=True)
        install = ("-m", "pip", "install", "--quiet", "--no-compile")  # which takes longer than to compile what is used
        _run(folder, tools / "bin/python", *install, "build", "twine")
        _run(folder, tools / "bin/python", "-m", "build", "--outdir", str(out), str(ROOT))
        built = [out / f"flockd-{__version__}.tar.gz", out / f"flockd-{__version__}-py3-none-any.whl"]
        _run(folder, tools / "bin/twine", "check", "--strict", *map(str, built))
        _run(folder, alone / "bin/python", *install, f"{built[1]}[sim]")
        (data,) = alone.glob("lib/python*/site-packages/flockd/_data")
        shutil.copy(PICTURE, folder / "picture.jpg")
        for step in STEPS:
            words = [word.format(data=data, folder=folder) for word in step.arguments]
            _run(folder, alone / "bin/flockd", *words, shows=step.shows, codes=step.codes)
    print(f"{built[0]} and {built[1]} are whole: installed alone, the wheel has flown")
    return 0


def _run(folder: Path, program: Path, *arguments: str, shows: str = "", codes: tuple[int, ...] = (0,)) -> None:
    """Raises SystemExit where it fails or does not show what it should. Nothing of the checkout is found by it."""
    print(f"$ {program.name} {' '.join(arguments)}", flush=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(program), *arguments]
    ended = subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    print(ended.stdout, end="", flush=True)
    if ended.returncode not in codes:
        raise SystemExit(f"check_wheel: {program.name} {' '.join(arguments)} ended with exit code {ended.returncode}")
    if shows not in ended.stdout:
        raise SystemExit(f"check_wheel: {program.name} {' '.join(arguments)} did not show {shows!r}")


if __name__ == "__main__":
    sys.exit(main())

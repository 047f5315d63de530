"""Builds what a stranger installs, and flies it: sdist and wheel, the wheel alone in an empty environment.

python -m tools.release.check_wheel --out dist

It needs a package index, and 1 GB in the folder for temporary files. Exit code 1: something of it failed, and is named.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

from flockd import __version__
from tools.release.lock import ROOT

STEPS = (
    ("--version",),
    ("models", "verify"),
    ("config", "check", "{data}/config/simulator.yaml"),
    ("sim", "--perception", "truth", "--duration", "5", "--drones", "3", "--out", "{folder}/flight"),
)
"""What is run of the installed package, in a folder that has nothing else."""


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
        _run(folder, tools / "bin/python", "-m", "pip", "install", "--quiet", "build", "twine")
        _run(folder, tools / "bin/python", "-m", "build", "--outdir", str(out), str(ROOT))
        built = [out / f"flockd-{__version__}.tar.gz", out / f"flockd-{__version__}-py3-none-any.whl"]
        _run(folder, tools / "bin/twine", "check", "--strict", *map(str, built))
        _run(folder, alone / "bin/python", "-m", "pip", "install", "--quiet", f"{built[1]}[sim]")
        (data,) = alone.glob("lib/python*/site-packages/flockd/_data")
        for step in STEPS:
            _run(folder, alone / "bin/flockd", *(word.format(data=data, folder=folder) for word in step))
    print(f"{built[0]} and {built[1]} are whole: installed alone, the wheel has flown")
    return 0


def _run(folder: Path, program: Path, *arguments: str) -> None:
    """Raises SystemExit where it fails. Nothing of the checkout is found by it."""
    print(f"$ {program.name} {' '.join(arguments)}", flush=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    ended = subprocess.run([str(program), *arguments], cwd=folder, env=environment, check=False)
    if ended.returncode:
        raise SystemExit(f"check_wheel: {program.name} {' '.join(arguments)} ended with exit code {ended.returncode}")


if __name__ == "__main__":
    sys.exit(main())

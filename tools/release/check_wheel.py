"""Build sdist and wheel, install the wheel alone in an empty environment, and fly it.

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
from collections.abc import Sequence
from pathlib import Path

from flockd import __version__
from tools.release.wheels import ROOT

PICTURE = ROOT / "tests/ground/pictures/rendered/4_m_4.jpg"
"""A picture of one drone."""


STEPS = (
    ("--version", (f"flockd {__version__}",)),
    ("models verify", ()),
    ("config check {data}/config/simulator.yaml", ()),
    ("sim --perception truth --duration 2 --drones 3 --out {folder}/flight", ()),
    ("detect --fov 90 {folder}/picture.jpg", ("detections: 1, images: 1",)),
    # It fails a step that is too slow, as it should on a busy computer; of what is installed nothing may be wrong.
    (
        "doctor --config {data}/config/simulator.yaml || true",
        ("PASS     model verification_int8  hash and golden output",),
    ),
)
"""What the installed command is given, in a folder that has nothing else, and what it has to print."""


def main() -> int:
    """Run each step; the first failure ends the check."""
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
        run([str(tools / "bin/python"), *install, "build", "twine"], folder)
        run([str(tools / "bin/python"), "-m", "build", "--outdir", str(out), str(ROOT)], folder)
        built = [out / f"flockd-{__version__}.tar.gz", out / f"flockd-{__version__}-py3-none-any.whl"]
        run([str(tools / "bin/twine"), "check", "--strict", *map(str, built)], folder)
        run([str(alone / "bin/python"), *install, f"{built[1]}[sim]"], folder)
        (data,) = alone.glob("lib/python*/site-packages/flockd/_data")
        shutil.copy(PICTURE, folder / "picture.jpg")
        for words, shows in STEPS:
            run(["sh", "-c", f"{alone}/bin/flockd {words.format(data=data, folder=folder)}"], folder, shows)
    print(f"{built[0]} and {built[1]} are whole: installed alone, the wheel has flown")
    return 0


def run(command: Sequence[str], folder: Path, shows: Sequence[str] = ()) -> None:
    """Runs it in a folder. Raises SystemExit where it fails or does not print what it should.

    Nothing of the checkout is found by it.
    """
    print(f"$ {' '.join(command)}", flush=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    ended = subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    print(ended.stdout, end="", flush=True)
    if ended.returncode:
        raise SystemExit(f"{' '.join(command)} ended with exit code {ended.returncode}")
    for text in shows:
        if text not in ended.stdout:
            raise SystemExit(f"{' '.join(command)} did not show {text!r}")


if __name__ == "__main__":
    sys.exit(main())

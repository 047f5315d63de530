"""Build the container, and install the Debian package, both in images of Debian 12; and run what is in them.

python -m tools.release.check_container --packages dist
python -m tools.release.check_container --packages dist --base localhost/debian:12   # where no registry is reached

Needs podman, buildah or docker (the first that is there, or `--builder`), which build for this computer's architecture.
The package of that architecture is taken from the folder. Exit code 1: something of it failed, and is named.
"""

from __future__ import annotations

import argparse
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from flockd import __version__
from tools.release.deb import MACHINES
from tools.release.wheels import ROOT

BUILDERS = ("podman", "buildah", "docker")
BASE = "docker.io/library/debian:12-slim"
IMAGE = f"localhost/flockd:{__version__}"
FLIGHT = Path("tests/review/replay/normal.mcap")
RUNS = f'test "$(flockd --version)" = "flockd {__version__}" && flockd models verify'
IN_THE_IMAGE = f"""\
FROM {IMAGE}
COPY {FLIGHT.name} /tmp/flight.mcap
RUN test "$(id -un)" = flockd && {RUNS} && flockd replay /tmp/flight.mcap --out /tmp/replayed
"""
"""What the image is checked by: a flight is replayed as the user that flies."""
OF_THE_PACKAGE = """\
FROM {base}
COPY {package} /tmp/
RUN apt-get update && apt-get install --yes --no-install-recommends /tmp/{package}
RUN {runs} && flockd config check /etc/flockd/drone.yaml
RUN apt-get purge --yes flockd && test ! -e /usr/lib/flockd && test ! -e /etc/flockd/drone.yaml
"""
"""What the package is checked by: installed, run, and gone again."""


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--packages", type=Path, required=True, metavar="FOLDER", help="where the Debian packages are")
    parser.add_argument("--base", default=BASE, help="an image of Debian 12 (default: %(default)s)")
    parser.add_argument(
        "--builder", choices=BUILDERS, help=f"default: the first that is there of {', '.join(BUILDERS)}"
    )
    args = parser.parse_args()
    builder = args.builder or next(filter(shutil.which, BUILDERS), None)
    if builder is None:
        raise SystemExit(f"check_container: none of {', '.join(BUILDERS)} is here; install one")
    architecture = next((deb for deb, kernel in MACHINES.items() if kernel == platform.machine()), None)
    packages = sorted(args.packages.glob(f"flockd_{__version__}+debian12_{architecture}.deb"))
    if not packages:
        raise SystemExit(f"check_container: no package of {architecture} and Debian 12 in {args.packages}; make deb")
    folder = args.packages.resolve()
    recipe = OF_THE_PACKAGE.format(base=args.base, package=packages[0].name, runs=RUNS)
    _build(builder, ["--build-arg", f"BASE={args.base}", "--tag", IMAGE], ROOT, None)
    _build(builder, [], ROOT / FLIGHT.parent, IN_THE_IMAGE)
    _build(builder, [], folder, recipe)
    print(f"{IMAGE} replays a flight; {packages[0]} is installed, runs and is gone without a trace")
    return 0


def _build(builder: str, options: Sequence[str], context: Path, recipe: str | None) -> None:
    """Raises SystemExit where a step of the recipe fails; None: the context's own."""
    command = [builder, "build", *options, *(("--file", "-") if recipe else ()), str(context)]
    print(f"$ {' '.join(command)}", flush=True)
    ended = subprocess.run(command, input=recipe, text=True, check=False)
    if ended.returncode != 0:
        raise SystemExit(f"check_container: {' '.join(command)} ended with exit code {ended.returncode}")


if __name__ == "__main__":
    sys.exit(main())

"""Check the licences of the packages of the lock, as pip-licenses reads them from what is installed.

python -m tools.release.licences                       # in this environment
python -m tools.release.licences .venv-service/bin/python

Prints the table; exit code 1 where a licence is not on the list, is unknown, or a package is not installed. Libraries
that a wheel carries inside (OpenCV's brings FFmpeg, LGPL-2.1) do not stand there.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Collection, Mapping, Sequence

from packaging.utils import canonicalize_name

from tools.release.wheels import names_of_lock

ALLOWED = frozenset(
    {
        *("0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "CC0-1.0", "ISC", "MIT", "MIT-0", "MPL-2.0"),
        *("PSF-2.0", "Unlicense", "Zlib", "3-Clause BSD License", "Apache Software License", "BSD License"),
        *("Apache License 2.0", "MIT License", "Mozilla Public License 2.0 (MPL 2.0)", "zlib License"),
        *("Python Software Foundation License", "Apache-2.0 OR BSD-2-Clause"),
        "BSD-3-Clause AND 0BSD AND MIT AND Zlib AND CC0-1.0",
    }
)
"""What metadata may say. Each lets flockd, Apache-2.0, be used and passed on with the package; GPL would not."""
STATED = {"eclipse-zenoh": "EPL-2.0 OR Apache-2.0", "protobuf": "BSD-3-Clause"}
"""SPDX, by what their LICENSE files say: zenoh's classifiers leave open whether both or either, protobuf has none."""


def installed(python: str = sys.executable) -> dict[str, str]:
    """What pip-licenses reads of each package of an environment. Raises CalledProcessError."""
    command = [sys.executable, "-m", "piplicenses", "--with-system", "--format=json", f"--python={python}"]
    rows = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    return {canonicalize_name(row["Name"]): row["License"] for row in rows}


def problems(wanted: Collection[str], said: Mapping[str, str]) -> list[str]:
    """A sentence for each package that cannot be used. Of several classifiers all have to be on the list."""
    missing = [
        f"{name} is not installed; `pip install -r requirements/service.txt`" for name in sorted({*wanted} - {*said})
    ]
    refused = [
        f"{name}: {said[name]} is not on the list of tools/release/licences.py; read it, or use another package"
        for name in sorted({*wanted} & {*said} - {*STATED})
        if not ALLOWED.issuperset(said[name].split("; "))
    ]
    return missing + refused


def main(arguments: Sequence[str]) -> int:
    """Command line."""
    wanted, said = names_of_lock(), installed(*arguments)
    print(*(f"{name:28}{STATED.get(name, said.get(name))}" for name in wanted), sep="\n")
    found = problems(wanted, said)
    print(*found, sep="\n", file=sys.stderr, end="\n" if found else "")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

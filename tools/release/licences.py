"""Check the licences of what is installed with flockd at run time: only those of the list, none unknown.

python -m tools.release.licences                            # a table; exit code 1 if a licence is refused
python -m tools.release.licences --extra ros --extra bags   # of extras too, which have to be installed

Licences are what the installed packages' metadata say: an SPDX expression, else the classifiers, else the free text,
else the package.xml that packages of ROS bring.
Libraries that a wheel carries inside (OpenCV's brings FFmpeg, LGPL-2.1) do not stand there.
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, files, metadata, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]

ALLOWED = frozenset(
    {
        *("0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "CC0-1.0", "ISC", "MIT", "MIT-0"),
        *("MPL-2.0", "PSF-2.0", "Unlicense", "Zlib"),
    }
)
"""SPDX names. Each lets flockd, Apache-2.0, be used and passed on with the package; GPL and AGPL would not."""
STATED = {
    "apsw": ("Zlib", "its LICENSE file: the terms of zlib, or any licence that OSI approves"),
    "ros-fastdds": ("Apache-2.0", "its LICENSE file"),
    "ros-fastcdr": ("Apache-2.0", "its LICENSE file"),
    "eclipse-zenoh": ("EPL-2.0 OR Apache-2.0", "its LICENSE file: two classifiers do not say whether both or either"),
}
"""Where metadata leave the licence open: what it is, and where that stands."""
NAMES = {
    "apache software license": "Apache-2.0",
    "apache 2.0": "Apache-2.0",
    "apache-2.0": "Apache-2.0",
    "apache license 2.0": "Apache-2.0",
    "apache license, version 2.0": "Apache-2.0",
    "zlib license": "Zlib",
    "bsd": "BSD-3-Clause",
    "bsd license": "BSD-3-Clause",
    "bsd-3-clause": "BSD-3-Clause",
    "3-clause bsd license": "BSD-3-Clause",
    "mit": "MIT",
    "mit license": "MIT",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "python software foundation license": "PSF-2.0",
}
"""SPDX names of what classifiers and free texts say."""
UNKNOWN = ""
_LICENSE = re.compile(r"<license[^>]*>([^<]+)</license>")
_CLASSIFIER = re.compile(r"License ::(?: OSI Approved ::)? (.+)")


@dataclass(frozen=True)
class Licence:
    """Licence of one installed package."""

    package: str
    version: str
    expression: str
    """SPDX; `UNKNOWN` where the metadata do not say."""

    @property
    def problem(self) -> str | None:
        """Why it cannot be used, in one sentence; None: it can."""
        if self.expression == UNKNOWN:
            return (
                f"{self.package} {self.version}: its licence is unknown; read it, and state it in "
                "tools/release/licences.py"
            )
        if not is_allowed(self.expression):
            return f"{self.package} {self.version}: {self.expression} is not on the list; use another package"
        return None


def is_allowed(expression: str) -> bool:
    """Whether an SPDX expression can be fulfilled with licences of the list alone."""
    tokens = re.findall(r"[()]|[^\s()]+", expression)
    value, rest = _either(tokens)
    return value and not rest


def _either(tokens: Sequence[str]) -> tuple[bool, Sequence[str]]:
    value, tokens = _both(tokens)
    while tokens and tokens[0] == "OR":
        other, tokens = _both(tokens[1:])
        value = value or other
    return value, tokens


def _both(tokens: Sequence[str]) -> tuple[bool, Sequence[str]]:
    value, tokens = _one(tokens)
    while tokens and tokens[0] == "AND":
        other, tokens = _one(tokens[1:])
        value = value and other
    return value, tokens


def _one(tokens: Sequence[str]) -> tuple[bool, Sequence[str]]:
    """A licence or a bracket; `A WITH exception` permits more than A, so what A permits."""
    if not tokens:
        return False, tokens
    if tokens[0] == "(":
        value, rest = _either(tokens[1:])
        return value and rest[:1] == [")"], rest[1:]
    rest = tokens[3:] if tokens[1:2] == ["WITH"] else tokens[1:]
    return tokens[0] in ALLOWED, rest


def expression_of(package: str, expression: str | None, classifiers: Iterable[str], text: str | None) -> str:
    """The SPDX expression of a package's metadata; of several classifiers all have to be fulfilled."""
    if package in STATED:
        return STATED[package][0]
    if expression:
        return expression
    said = [found[1] for line in classifiers if (found := _CLASSIFIER.fullmatch(line))]
    said = said or ([text] if text and "\n" not in text.strip() else [])
    names = [NAMES.get(one.strip().lower(), f"LicenseRef-{one.strip()}".replace(" ", "-")) for one in said]
    return " AND ".join(names) or UNKNOWN


def licence_of(package: str) -> Licence:
    """Raises PackageNotFoundError where it is not installed."""
    facts = metadata(package)
    classifiers = facts.get_all("Classifier") or _classifiers_of_ros(package)
    expression = expression_of(package, facts["License-Expression"], classifiers, facts["License"])
    return Licence(package, facts["Version"], expression)


def _classifiers_of_ros(package: str) -> list[str]:
    """What the package.xml of a wheel of ROS says, as classifiers would."""
    found = [one for one in files(package) or () if one.name == "package.xml"]
    return [f"License :: {text}" for one in found for text in _LICENSE.findall(one.read_text())]


def needed_by(package: str) -> tuple[str, ...]:
    """What an installed package needs at run time, without its extras."""
    wanted = [Requirement(one) for one in requires(package) or ()]
    return tuple(
        canonicalize_name(one.name) for one in wanted if one.marker is None or one.marker.evaluate({"extra": ""})
    )


def declared_packages(extras: Sequence[str] = ()) -> tuple[str, ...]:
    """What pyproject.toml names for run time, and for extras on this Python and computer."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [*project["dependencies"], *(one for extra in extras for one in project["optional-dependencies"][extra])]
    wanted = [Requirement(one) for one in named]
    return tuple(canonicalize_name(one.name) for one in wanted if one.marker is None or one.marker.evaluate())


def runtime_packages(extras: Sequence[str] = ()) -> tuple[str, ...]:
    """What flockd and these extras need at run time, and what that needs, by name. Raises PackageNotFoundError."""
    waiting: list[str] = list(declared_packages(extras))
    found: set[str] = set()
    while waiting:
        package = waiting.pop()
        if package not in found:
            found.add(package)
            waiting.extend(needed_by(package))
    return tuple(sorted(found))


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description="Check the licences of what is installed with flockd.")
    parser.add_argument("--extra", action="append", default=[], help="of pyproject.toml; may be given again")
    extras = parser.parse_args().extra
    try:
        licences = [licence_of(package) for package in runtime_packages(extras)]
    except PackageNotFoundError as error:
        print(f"licences: {error.name} is not installed; `pip install .`", file=sys.stderr)
        return 69
    for licence in licences:
        print(f"{licence.package:28}{licence.version:12}{licence.expression or 'unknown'}")
    problems = [licence.problem for licence in licences if licence.problem]
    print(*problems, sep="\n", file=sys.stderr, end="\n" if problems else "")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())

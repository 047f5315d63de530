"""Break flockd on purpose, in one place at a time, and see that a test fails each time.

python -m tools.checks.breakages                # the fixed list of breakages.yaml, a few minutes: what CI runs
python -m tools.checks.breakages --only fence   # those whose name or file contains the word
python -m tools.checks.breakages --mutants 60   # so many small changes of the safety layer, drawn by its sources
python -m tools.checks.breakages --mutants 0    # all of them, about a quarter of an hour

A fixed breakage names a folder, a text that occurs there exactly once, what replaces it, and the tests that must fail
by their functions' names, wherever these stand. Exit code 1: one was not noticed, or its text or its test is not found
any more, or a mutant survived that the file does not explain. Works in copies; needs an operating system that can fork.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from tools.checks.mutants import FILES, ROOT, SAFETY, Mutant, mutants_of, sample

LIST = Path(__file__).with_suffix(".yaml")
WALL_LIMIT_S = 180
"""Limit for a breakage that never ends; its tests take much less."""
LOADED = ("numpy", "scipy.optimize", "scipy.spatial", "cv2", "pydantic", "yaml", "hypothesis", "onnxruntime", "numba")
"""Unchanged libraries, loaded before forking."""


class StaleError(Exception):
    """An entry of the list does not fit the sources any more."""


@dataclass(frozen=True)
class Breakage:
    """One changed copy of one file, and the tests to try it with."""

    name: str
    file: Path
    """Relative to the root."""
    source: str
    tests: tuple[str, ...]
    """What pytest takes: files, or ids."""


def main() -> int:
    """Try the breakages; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="WORD", default="", help="those whose name or file contains it")
    parser.add_argument("--mutants", metavar="N", type=int, help="N mutants of the safety layer instead; 0: all")
    arguments = parser.parse_args()
    listed = yaml.safe_load(LIST.read_text(encoding="utf-8"))
    try:
        if arguments.mutants is None:
            chosen = fixed(listed["breakages"])
        else:
            chosen = small_changes(arguments.mutants, listed["tests of mutants"])
    except StaleError as error:
        print(f"{LIST.name}: {error}", file=sys.stderr)
        return 1
    chosen = [one for one in chosen if arguments.only in f"{one.name} {one.file}"]
    with tempfile.TemporaryDirectory(prefix="flockd-broken-") as folder:
        folders = [Path(folder) / str(number) for number in range(max(1, min(os.cpu_count() or 1, len(chosen))))]
        prepare(folders, sorted({test for one in chosen for test in one.tests}))
        survivors = list(surviving(chosen, folders))
    whole = arguments.mutants == 0 and not arguments.only
    return report(chosen, survivors, listed["equivalent mutants"] if arguments.mutants is not None else {}, whole=whole)


def fixed(entries: Sequence[Mapping[str, Any]]) -> list[Breakage]:
    """The listed breakages. Raises StaleError that names all entries that do not fit."""
    found, stale = [], []
    for entry in entries:
        try:
            file, source = changed(entry["in"], entry["old"], entry["new"])
            tests = tuple(_test(name) for name in entry["tests"])
            found.append(Breakage(entry["name"], file, source, tests))
        except StaleError as error:
            stale.append(f"{entry['name']}: {error}")
    if stale:
        raise StaleError("; ".join(stale))
    return found


def small_changes(count: int, tests: Mapping[str, Sequence[str]]) -> list[Breakage]:
    """This many mutants of the safety layer; 0: all."""
    mutants: list[Mutant] = [mutant for path in FILES for mutant in mutants_of(path)]
    mutants = sample(mutants, count) if count else mutants
    return [
        Breakage(
            one.name, SAFETY / one.file, one.source,
            tuple(f"tests/flight/safety/{name}" for name in tests.get(one.file, tests["others"])),
        )
        for one in mutants
    ]  # fmt: skip


def changed(where: str, old: str, new: str, root: Path = ROOT) -> tuple[Path, str]:
    """The one file under a folder that holds the text, from `root` on, and its source with the other one.

    Raises StaleError where the text is not there once.
    """
    place = root / where
    files = [place] if place.is_file() else sorted(place.rglob("*.py"))
    holding = [(path, text) for path in files if old in (text := path.read_text(encoding="utf-8"))]
    times = sum(text.count(old) for _, text in holding)
    if times != 1:
        raise StaleError(f"its text is {times} times in {where}, and has to be there once: {old!r}")
    ((path, text),) = holding
    return path.relative_to(root), text.replace(old, new)


def _test(name: str) -> str:
    """The id of the one test function of this name; of one of its parameters with `[...]` behind."""
    function = name.partition("[")[0]
    files = _tests().get(function, ())
    if len(files) != 1:
        raise StaleError(f"{len(files)} tests are named {function}")
    return f"{files[0]}::{name}"


@functools.cache
def _tests() -> dict[str, list[str]]:
    """By function, the files that hold a test of this name."""
    found: dict[str, list[str]] = {}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for function in re.findall(r"^(?:async )?def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE):
            found.setdefault(function, []).append(str(path.relative_to(ROOT)))
    return found


def report(
    tried: Sequence[Breakage], survivors: Sequence[Breakage], equivalent: Mapping[str, str], *, whole: bool
) -> int:
    """Print the survivors; return the exit code."""
    unexplained = [one for one in survivors if one.name not in equivalent]
    for one in survivors:
        print(f"{one.file}: {one.name}\n    {equivalent.get(one.name, 'SURVIVED')}")
    print(
        f"{len(tried)} breakages: {len(tried) - len(survivors)} noticed, {len(survivors) - len(unexplained)} change "
        f"nothing, {len(unexplained)} survived"
    )
    # Of two changes of one function with the same text a sample may hold the one that tests notice.
    stale = set(equivalent) - {one.name for one in survivors} if whole else set()
    for name in sorted(stale):
        print(f"{LIST.name} explains what did not survive; delete it: {name}")
    return 1 if unexplained or stale else 0


# Running the tests.


def prepare(folders: Sequence[Path], tests: Sequence[str]) -> None:
    """Makes copies of links, tries the tests there without any change, and loads what does not change."""
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    files = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    kept = [str(path.relative_to(ROOT)) for path in (ROOT / "flockd").rglob("__pycache__/*.nb?")]  # compiled kernels
    for folder in folders:
        for file in (*files, *kept):
            if (ROOT / file).is_file():
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                if file in kept:
                    shutil.copy2(ROOT / file, folder / file)
                else:
                    (folder / file).symlink_to(ROOT / file)
    for name in LOADED:
        importlib.import_module(name)
    child = os.fork()
    if child == 0:
        _run_tests(folders[0], tests, 20 * WALL_LIMIT_S, quiet=False)
    if os.waitpid(child, 0)[1] != 0:
        sys.exit("the tests fail without any change; fix them first")


def surviving(breakages: Sequence[Breakage], folders: Sequence[Path]) -> Iterator[Breakage]:
    """The breakages with which all of their tests pass; one at a time in each folder."""
    free, running, began_s = list(folders), dict[int, tuple[Breakage, Path]](), time.monotonic()
    for number, one in enumerate((*breakages, *[None] * len(folders))):
        if one is None or not free:
            if not running:
                return
            child, status = os.wait()
            ended, folder = running.pop(child)
            _put_back(ended, folder)
            free.append(folder)
            if status == 0:
                yield ended
        if one is not None:
            if number % 20 == 0:
                print(f"{number} of {len(breakages)}, {time.monotonic() - began_s:.0f} s", file=sys.stderr)
            folder = free.pop()
            (folder / one.file).unlink()
            (folder / one.file).write_text(one.source, encoding="utf-8")
            child = os.fork()
            if child == 0:
                _run_tests(folder, one.tests, WALL_LIMIT_S)
            running[child] = one, folder


def _put_back(one: Breakage, folder: Path) -> None:
    """Restore the file and delete its bytecode: the next change may have the same size and second."""
    path = folder / one.file
    path.unlink()
    path.symlink_to(ROOT / one.file)
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        compiled.unlink()


def _run_tests(folder: Path, tests: Sequence[str], limit_s: int, *, quiet: bool = True) -> None:
    """In a forked process, which it ends: with 0 if all tests pass."""
    code = 1
    try:
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
        signal.alarm(limit_s)
        os.chdir(folder)
        sys.path[:] = [str(folder), *(path for path in sys.path if path and Path(path).resolve() != ROOT)]
        for name in [name for name in sys.modules if name.partition(".")[0] in {"flockd", "tests", "tools"}]:
            del sys.modules[name]
        if quiet:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
        code = int(pytest.main(["-x", "-m", "", "-p", "no:cacheprovider", "-p", "no:xdist", *tests]))
        loaded = str(sys.modules["flockd"].__file__)
        if not loaded.startswith(str(folder)):
            print(f"{loaded} was imported, not the copy in {folder}", file=sys.stderr)
            code = 1
    finally:
        os._exit(code)


if __name__ == "__main__":
    sys.exit(main())

"""Prints the size and structure of a checkout: folders, files, lines, arrows, circles, longest parts, tuned numbers.

    python -m tools.measure.structure_metrics [CHECKOUT]

CHECKOUT is the folder that holds `flockd/`, by default this one; an older checkout gives the figures before a change.
A room is what stands directly in `flockd/`, folder or file. An arrow goes from a room to another that it imports,
anywhere in a file; a circle is a set of rooms, or of files, each of which reaches each other along arrows.
"""

from __future__ import annotations

import argparse
import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

COUNTED = ("flockd", "tests", "tools")
CONFIGURATION = "config"
"""The folder whose defaults are the shipped configuration: they are counted by themselves."""

Arrows = set[tuple[str, str]]


def metrics(checkout: Path) -> dict[str, str]:
    """One line of text a figure. Raises SyntaxError if a file of ``checkout / "flockd"`` is not Python."""
    package = checkout / "flockd"
    texts = {path: path.read_text(encoding="utf-8") for path in sorted(package.rglob("*.py"))}
    trees = {path.relative_to(package): ast.parse(text) for path, text in texts.items()}
    lines = {path.relative_to(package): len(text.splitlines()) for path, text in texts.items()}
    longest = max(lines, key=lambda path: lines[path])
    function_lines, function = max(found for path, tree in trees.items() for found in _functions(path, tree))
    files = {arrow for path, tree in trees.items() for arrow in _imports(path, tree, set(trees))}
    rooms = {(_room(start), _room(end)) for start, end in files if _room(start) != _room(end)}
    constants = sum(len(list(_constants(tree))) for tree in trees.values())
    defaults = {path: len(list(_field_defaults(tree))) for path, tree in trees.items()}
    configured = sum(count for path, count in defaults.items() if CONFIGURATION in path.parts)
    return {
        "rooms of flockd": f"{len({path.parts[0] for path in trees if path.name != '__init__.py' or path.parts[1:]})}",
        "folders of flockd": f"{len({path.parent for path in trees} - {Path()})}",
        "files of flockd": f"{len(trees)}",
        **{f"lines of {folder}": f"{_lines(checkout / folder):,}" for folder in COUNTED},
        "lines together": f"{sum(_lines(checkout / folder) for folder in COUNTED):,}",
        "arrows between rooms": f"{len(rooms)}",
        "circles of rooms": _circles(rooms),
        "circles of files": _circles(files),
        "longest file": f"{lines[longest]} lines, {longest}",
        "longest function": f"{function_lines} lines, {function}",
        "tuned numbers": f"{constants + sum(defaults.values())}",
        "of these, constants": f"{constants}",
        "of these, defaults of the configuration": f"{configured}",
        "of these, defaults of other fields": f"{sum(defaults.values()) - configured}",
    }


def _lines(folder: Path) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob("*.py"))


def _room(file: str) -> str:
    return file.partition("/")[0].removesuffix(".py")


def _functions(path: Path, tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Lines, from `def` to the end, and name of each function and method."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            yield node.end_lineno - node.lineno + 1, f"{path}: {node.name}"


def _constants(tree: ast.Module) -> Iterator[str]:
    """Names in capitals that a module gives a value with a number in it; each of `A, B = 1, 2` counts."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and _has_number(node.value):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = (part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name))
            yield from (name for name in names if name.isupper())


def _field_defaults(tree: ast.Module) -> Iterator[str]:
    """Annotated fields of classes (dataclasses, named tuples, sections) whose default has a number in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            for part in node.body:
                if isinstance(part, ast.AnnAssign) and part.value is not None and _has_number(part.value):
                    yield ast.unparse(part.target)


def _has_number(value: ast.expr) -> bool:
    """Whether a number other than 0, where counting starts, stands in an expression."""
    numbers = (part.value for part in ast.walk(value) if isinstance(part, ast.Constant))
    return any(type(number) in {int, float} and number != 0 for number in numbers)


def _imports(path: Path, tree: ast.Module, files: set[Path]) -> Iterator[tuple[str, str]]:
    """From a file to each other file of the package that it imports; imports for type checkers count too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for parts in (name.split(".") for name in names):
            found = _file(parts[1:], files) if parts[0] == "flockd" else None
            if found is not None and found != path:
                yield path.as_posix(), found.as_posix()


def _file(parts: list[str], files: set[Path]) -> Path | None:
    """The file of a dotted name below `flockd`, which may end in a name of that file; None for `flockd` itself."""
    for end in range(len(parts), 0, -1):
        place = Path(*parts[:end])
        for candidate in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
            if candidate in files:
                return candidate
    return None


def _circles(arrows: Arrows) -> str:
    """How many circles, and the members of each."""
    names = sorted({name for arrow in arrows for name in arrow})
    graph = np.zeros((len(names), len(names)), dtype=bool)
    for start, end in arrows:
        graph[names.index(start), names.index(end)] = True
    count, labels = connected_components(graph, directed=True, connection="strong")
    groups = ([name for name, label in zip(names, labels, strict=True) if label == group] for group in range(count))
    circles = [" - ".join(group) for group in groups if len(group) > 1]
    return f"{len(circles)}" + "".join(f"; {circle}" for circle in circles)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", metavar="CHECKOUT", nargs="?", type=Path, default=Path(__file__).parents[2])
    checkout = parser.parse_args().checkout
    if not (checkout / "flockd").is_dir():
        parser.error(f"{checkout}: has no folder flockd/; name a checkout")
    print("| figure | value |\n|---|---|")
    for name, value in metrics(checkout).items():
        print(f"| {name} | {value} |")


if __name__ == "__main__":
    main()

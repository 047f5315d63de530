"""Prints the size and shape of the package: files, longest file and function, named constants, import arrows.

    python -m tools.measure.house_metrics [CHECKOUT]

CHECKOUT is the folder that holds `flockd/`, by default this one; an older checkout gives the figures before a change.
"""

from __future__ import annotations

import argparse
import ast
from collections.abc import Iterator
from pathlib import Path

FLIGHT_FOLDERS = ("pilot", "perception", "tracking")
"""What estimates: its constants are counted by themselves."""


def metrics(package: Path) -> dict[str, str]:
    """One line of text a figure, of the Python files under ``package``. Raises SyntaxError for one that is none."""
    texts = {path: path.read_text(encoding="utf-8") for path in sorted(package.rglob("*.py"))}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    lines = {path: len(text.splitlines()) for path, text in texts.items()}
    longest = max(lines, key=lambda path: lines[path])
    function_lines, function = max(found for path, tree in trees.items() for found in _functions(path, tree, package))
    constants = {path: len(list(_numeric_constants(tree))) for path, tree in trees.items()}
    in_flight = sum(count for path, count in constants.items() if _folder(path, package) in FLIGHT_FOLDERS)
    arrows = {arrow for path, tree in trees.items() for arrow in _arrows(path, tree, package)}
    return {
        "files": f"{len(texts)}",
        "lines": f"{sum(lines.values())}",
        "longest file": f"{lines[longest]} lines, {longest.relative_to(package)}",
        "longest function": f"{function_lines} lines, {function}",
        f"numeric constants in {', '.join(FLIGHT_FOLDERS)}": f"{in_flight}",
        "numeric constants": f"{sum(constants.values())}",
        "import arrows between top folders": f"{len(arrows)}",
    }


def _folder(path: Path, package: Path) -> str:
    return path.relative_to(package).parts[0].removesuffix(".py")


def _functions(path: Path, tree: ast.Module, package: Path) -> Iterator[tuple[int, str]]:
    """Lines, from `def` to the end, and name of each function and method."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            yield node.end_lineno - node.lineno + 1, f"{path.relative_to(package)}: {node.name}"


def _numeric_constants(tree: ast.Module) -> Iterator[str]:
    """Names in capitals that a module gives a value with a number in it; each of `A, B = 1, 2` counts."""
    for node in tree.body:
        if isinstance(node, ast.Assign):
            targets, value = node.targets, node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            targets, value = [node.target], node.value
        else:
            continue
        if any(isinstance(part, ast.Constant) and type(part.value) in {int, float} for part in ast.walk(value)):
            names = (part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name))
            yield from (name for name in names if name.isupper())


def _arrows(path: Path, tree: ast.Module, package: Path) -> Iterator[tuple[str, str]]:
    """From the file's folder to each other that it imports; those that only type checkers follow count too."""
    own = _folder(path, package)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == package.name:
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            modules = [node.module]
        else:
            continue
        for parts in (module.split(".") for module in modules):
            if parts[0] == package.name and len(parts) > 1 and parts[1] != own and not parts[1].startswith("__"):
                yield own, parts[1]


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", metavar="CHECKOUT", nargs="?", type=Path, default=Path(__file__).parents[2])
    package = parser.parse_args().checkout / "flockd"
    if not package.is_dir():
        parser.error(f"{package}: is no folder; name the checkout that holds flockd/")
    for name, value in metrics(package).items():
        print(f"{name}: {value}")


if __name__ == "__main__":
    main()

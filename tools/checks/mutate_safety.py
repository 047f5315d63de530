"""Prove the tests of flockd/flight/safety: change its source in one place at a time, and see that a test fails each
time.

python -m tools.checks.mutate_safety                 # all mutants, about a quarter of an hour
python -m tools.checks.mutate_safety --sample 60     # so many of them, about a minute: what CI runs
python -m tools.checks.mutate_safety --only gate.py  # one file

The sample is drawn with a seed made from the sources, so that the same sources give the same sample and every change of
them another one. Prints the changes that no test noticed. Exit code 1 if one of them is not in EQUIVALENT, which lists
those that change nothing, with the reason. Works in a copy; needs an operating system that can fork.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import importlib
import itertools
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SAFETY = Path("flockd/flight/safety")
TESTS = {
    "gate.py": ("test_gate.py", "test_obstacles.py", "test_fence.py", "test_response.py", "test_supervisor.py"),
    "approach.py": ("test_obstacles.py", "test_gate.py", "test_fence.py", "test_supervisor.py"),
    "half_planes.py": ("test_obstacles.py", "test_gate.py", "test_fence.py", "test_supervisor.py"),
    "fence.py": ("test_fence.py", "test_gate.py", "test_supervisor.py"),
    "response.py": ("test_response.py",),
    "surroundings.py": ("test_surroundings.py",),
}
"""The files of tests/flight/safety, the likeliest to notice first; else the supervisor's."""
SUPERVISORS_TESTS = ("test_supervisor.py", "test_gate.py", "test_obstacles.py", "test_fence.py")
CPU_LIMIT_S = 60
"""For a mutant that never ends; many times what the tests take."""

EQUIVALENT: dict[str, str] = {
    "policy.py Reaction: SILENCE = (7)": "only the order counts, and it is still the worst",
    "policy.py Barrier: LATCH = (3)": "only the order counts, and it is still the worst",
    'policy.py Barrier: WAIT = 2 """Not ready while it lasts.""" LATCH = 1': (
        "the order counts for how reasons are reported, and what latches is reported first anyway"
    ),
    "policy.py Rule: later: Reaction = Reaction.RETURN": "it never comes where no `after_s` is given: that is infinite",
    "supervisor.py _Flight: asked: Reaction = Reaction.DEGRADE": "whatever may be asked for is worse still",
    "supervisor.py _Flight: asked_s: float = (0.0)": "written when something is asked for, and read only afterwards",
    "supervisor.py Supervisor.__init__: self._state = State.READY": "latched, the first step makes it idle",
    "supervisor.py Supervisor.__init__: pass  # self._flight = _Flight()": "each flight begins with a new one",
    "supervisor.py Supervisor.__init__: pass  # self._now_s = -math.inf": "each step writes it before it is read",
    "supervisor.py Supervisor.__init__: self._now_s = (math.inf)": "each step writes it before it is read",
    "supervisor.py Supervisor.__init__: self._now_s = -(0.0)": "each step writes it before it is read",
    "gate.py Gate.__init__: pass  # self._result = np.zeros(2)": "read only after it was written",
    "gate.py Gate.__init__: self._result = np.zeros((3))": "read only after it was written",
    "gate.py Gate.__init__: self._result = np.zeros((0))": "read only after it was written",
    "gate.py Gate._between_neighbours: if False:": "the room beside nobody is infinite; it only saves time",
    "approach.py towards_neighbours: if False:": "of none there are no limits; it only saves time",
    "approach.py towards_obstacles: if False:": "of none there are no limits; it only saves time",
    "half_planes.py nearest_within: if ((over < 0)).all():": (
        "with a limit just reached, its foot is the velocity itself"
    ),
    "half_planes.py nearest_within: fits = "
    "(np.max(candidates @ directions.T - limits, axis=1, initial=-np.inf) < _ROUNDING_M_S)": (
        "differs where the rounding is exactly the rounding allowed"
    ),
    "half_planes.py nearest_within: binding = ~((limits >= np.hypot(*velocity) + _ROUNDING_M_S))"
    "  # the others hold for all that is no longer": "a limit of just this speed binds nothing",
    "half_planes.py nearest_within: fits = (np.max(candidates @ directions.T - limits, axis=1)) <= _ROUNDING_M_S": (
        "a limit that is exceeded binds, so that there always is one, unless a direction is longer than 1 by rounding"
    ),
    "half_planes.py : _PARALLEL = (0.0)": "lines that are all but parallel cross far away, or as near as a foot",
    "half_planes.py _crossings: cross = (np.abs(determinants) >= _PARALLEL)": "the same, at just this angle",
    "half_planes.py _crossings: i, j = np.triu_indices(len(directions), (0))": "a line is parallel to itself",
    "fence.py _nearest_of_sides: sides = np.roll(corners, (1), axis=0) - corners": (
        "the same outline, the other way round"
    ),
}
"""What survives because it means the same as before, by `Mutant.name`; and why."""

Edit = tuple[ast.expr | ast.stmt, str]


@dataclass(frozen=True)
class Mutant:
    """One changed copy of one file."""

    file: str
    line: int
    place: str
    """The class and function it is in."""
    changed: str
    """The changed lines, stripped, one after another."""
    source: str

    @property
    def name(self) -> str:
        """By which it is known in EQUIVALENT; without the line number, which moves."""
        return f"{self.file} {self.place}: {self.changed}"


def main() -> int:
    """Runs the tests against every mutant."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="FILE", help="mutate one file of flockd/flight/safety")
    parser.add_argument("--sample", metavar="N", type=int, help="try N mutants, drawn at random")
    parser.add_argument("--seed", metavar="TEXT", help="to draw them with (default: a hash of the sources)")
    parser.add_argument("--list", action="store_true", help="print the mutants and run nothing")
    arguments = parser.parse_args()
    files = sorted(path for path in (ROOT / SAFETY).glob("*.py") if arguments.only in (None, path.name))
    if not files:
        parser.error(f"there is no {arguments.only} in {SAFETY}")
    mutants = [mutant for path in files for mutant in mutants_of(path)]
    if arguments.sample is not None:
        seed = arguments.seed or hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:8]
        print(f"seed {seed}")
        mutants = sample(mutants, arguments.sample, seed)
    if arguments.list:
        print(*(f"line {mutant.line} of {mutant.name}" for mutant in mutants), sep="\n")
        return 0
    with tempfile.TemporaryDirectory() as folder:
        prepare(Path(folder))
        survivors = [mutant for mutant in with_progress(mutants) if survives(mutant, Path(folder))]
    return report(mutants, survivors, whole=arguments.sample is None)


def sample(mutants: Sequence[Mutant], count: int, seed: str) -> list[Mutant]:
    """So many of them, or all where there are no more, in their own order."""
    chosen = random.Random(seed).sample(range(len(mutants)), min(count, len(mutants)))
    return [mutants[index] for index in sorted(chosen)]


def report(mutants: Sequence[Mutant], survivors: Sequence[Mutant], *, whole: bool) -> int:
    """Prints the table of survivors; the exit code."""
    unexplained = [mutant for mutant in survivors if mutant.name not in EQUIVALENT]
    for mutant in survivors:
        verdict = EQUIVALENT.get(mutant.name, "SURVIVED")
        print(f"line {mutant.line} of {mutant.name}\n    {verdict}")
    killed = len(mutants) - len(survivors)
    print(f"{len(mutants)} mutants: {killed} killed, {len(survivors) - len(unexplained)} equivalent, ", end="")
    print(f"{len(unexplained)} survived")
    files = {mutant.file for mutant in mutants}
    # Of two changes of one function with the same text a sample may hold the one that tests notice.
    expected = {name for name in EQUIVALENT if whole and name.partition(" ")[0] in files}
    stale = expected - {mutant.name for mutant in survivors}
    for name in sorted(stale):
        print(f"EQUIVALENT has an entry without a survivor; delete it: {name}")
    return 1 if unexplained or stale else 0


def with_progress(mutants: Sequence[Mutant]) -> Iterator[Mutant]:
    """The mutants, with a line to the terminal now and then."""
    began_s = time.monotonic()
    for number, mutant in enumerate(mutants):
        if number % 25 == 0:
            print(f"{number} of {len(mutants)}, {time.monotonic() - began_s:.0f} s", file=sys.stderr)
        yield mutant


# Running the tests.


def prepare(folder: Path) -> None:
    """Copies what the tests need, tries the tests, and loads here what does not change, so that a fork is quick."""
    ignored = shutil.ignore_patterns("__pycache__", "*.so")
    for part in ("flockd", "config", "tests/flight/safety", "tests/hostile"):
        shutil.copytree(ROOT / part, folder / part, ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", folder)
    shutil.copy(ROOT / "tests" / "make.py", folder / "tests")
    os.chdir(folder)
    tried = subprocess.run([sys.executable, "-m", "pytest", "tests/flight/safety"], check=False)
    if tried.returncode != 0:
        sys.exit("the tests fail without any change; fix them first")
    shutil.rmtree(folder / SAFETY / "__pycache__", ignore_errors=True)
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(folder))
    loaded = importlib.import_module("flockd.core.config.safety").__file__
    if not str(loaded).startswith(str(folder)):
        sys.exit(f"{loaded} was imported, not the copy in {folder}")


def survives(mutant: Mutant, folder: Path) -> bool:
    """Whether all tests pass with the mutant in place of its file."""
    path = folder / SAFETY / mutant.file
    original = path.read_text(encoding="utf-8")
    path.write_text(mutant.source, encoding="utf-8")
    child = os.fork()
    if child == 0:
        _run_tests(TESTS.get(mutant.file, SUPERVISORS_TESTS))
    _, status = os.waitpid(child, 0)
    path.write_text(original, encoding="utf-8")
    return status == 0


def _run_tests(files: Sequence[str]) -> None:
    """In a forked process, which it ends: with 0 if all tests pass."""
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT_S, CPU_LIMIT_S))
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    code = 1
    try:
        paths = [f"tests/flight/safety/{file}" for file in files]
        code = int(pytest.main(["-x", "-p", "no:cacheprovider", "-p", "no:xdist", *paths]))
    finally:
        os._exit(code)


# Making mutants.


def mutants_of(path: Path) -> Iterator[Mutant]:
    """All mutants of a file."""
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    seen = {ast.unparse(tree)}
    for edits in _edits(tree):
        mutated = _edited(source, edits)
        meaning = ast.unparse(ast.parse(mutated))
        if meaning not in seen:
            seen.add(meaning)
            before, after = source.splitlines(), mutated.splitlines()
            first = next(n for n, (a, b) in enumerate(zip(before, after, strict=False)) if a != b)
            kept = next(n for n, (a, b) in enumerate(zip(before[::-1], after[::-1], strict=False)) if a != b)
            changed = " ".join(line.strip() for line in after[first : max(len(after) - kept, first + 1)])
            yield Mutant(path.name, first + 1, _place(tree, first + 1), changed, mutated)


def _place(node: ast.AST, line: int) -> str:
    """The dotted name of the innermost class or function that a line is in."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt) and child.lineno <= line <= (child.end_lineno or child.lineno):
            inner = _place(child, line)
            if isinstance(child, ast.ClassDef | ast.FunctionDef):
                return f"{child.name}.{inner}".rstrip(".")
            return inner
    return ""


def _edited(source: str, edits: Sequence[Edit]) -> str:
    """The source with some nodes, from the last to the first, written anew."""
    lines = source.encode().splitlines(keepends=True)
    starts = [sum(map(len, lines[:number])) for number in range(len(lines))]
    raw = source.encode()
    for node, text in sorted(edits, key=lambda edit: (edit[0].lineno, edit[0].col_offset), reverse=True):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        raw = raw[:begin] + text.encode() + raw[end:]
    return raw.decode()


COMPARISONS: dict[type[ast.cmpop], tuple[ast.cmpop, ...]] = {
    ast.Lt: (ast.LtE(), ast.GtE()),
    ast.LtE: (ast.Lt(), ast.Gt()),
    ast.Gt: (ast.GtE(), ast.LtE()),
    ast.GtE: (ast.Gt(), ast.Lt()),
    ast.Eq: (ast.NotEq(),),
    ast.NotEq: (ast.Eq(),),
    ast.Is: (ast.IsNot(),),
    ast.IsNot: (ast.Is(),),
    ast.In: (ast.NotIn(),),
    ast.NotIn: (ast.In(),),
}
OPERATORS: dict[type[ast.operator], ast.operator] = {
    ast.Add: ast.Sub(),
    ast.Sub: ast.Add(),
    ast.Mult: ast.Div(),
    ast.Div: ast.Mult(),
    ast.Pow: ast.Mult(),
    ast.BitOr: ast.BitAnd(),
    ast.BitAnd: ast.BitOr(),
}
OPPOSITES = {
    "min": "max",
    "max": "min",
    "any": "all",
    "all": "any",
    "argmin": "argmax",
    "argmax": "argmin",
    "minimum": "maximum",
    "maximum": "minimum",
}


def _edits(tree: ast.Module) -> Iterator[list[Edit]]:
    """Every single change of a file: mostly one node each."""
    enums = _enums()
    for node in _code(tree):
        if isinstance(node, ast.stmt):
            for edit in _of_statement(node):
                yield [edit]
        if isinstance(node, ast.expr):
            for text in _of_expression(node):
                yield [(node, f"({text})")]
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in enums:
            members = enums[node.value.id]
            other = members[(members.index(node.attr) + 1) % len(members)] if node.attr in members else node.attr
            yield [(node, f"{node.value.id}.{other}")]
        if isinstance(node, ast.ClassDef) and any(isinstance(b, ast.Name) and b.id == "IntEnum" for b in node.bases):
            values = [statement.value for statement in node.body if isinstance(statement, ast.Assign)]
            for a, b in itertools.pairwise(values):  # swapped severities
                yield [(a, ast.unparse(b)), (b, ast.unparse(a))]


def _enums() -> dict[str, list[str]]:
    """The members of every enumeration in flockd/flight/safety."""
    enums: dict[str, list[str]] = {}
    for path in (ROOT / SAFETY).glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and any(ast.unparse(base).endswith("Enum") for base in node.bases):
                targets = [statement.targets[0] for statement in node.body if isinstance(statement, ast.Assign)]
                enums[node.name] = [target.id for target in targets if isinstance(target, ast.Name)]
    return enums


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes of a tree that are run for what they do: no annotations, no texts, no imports."""
    if isinstance(node, ast.JoinedStr | ast.Import | ast.ImportFrom):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name not in ("annotation", "returns", "decorator_list", "bases"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from _code(child)


def _of_statement(node: ast.stmt) -> Iterator[Edit]:
    match node:
        case ast.If():
            yield node.test, "True"
            yield node.test, "False"
        case ast.Expr(value=ast.Call()) | ast.AugAssign() | ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            yield node, f"pass  # {ast.unparse(node).splitlines()[0]}"
        case ast.Return(value=ast.expr()):
            yield node, "return None"


def _of_expression(node: ast.expr) -> Iterator[str]:
    """What an expression is changed into."""
    yield from _of_logic(node)
    yield from _of_number(node)
    match node:
        case ast.Attribute(attr=name) if name in OPPOSITES:
            yield ast.unparse(ast.Attribute(node.value, OPPOSITES[name]))
        case ast.Call(func=ast.Name(id=name)) if name in OPPOSITES:
            yield ast.unparse(ast.Call(ast.Name(OPPOSITES[name]), node.args, node.keywords))
        case ast.Call(func=ast.Name(id="abs" | "sorted" | "bool"), args=[argument, *_]):
            yield ast.unparse(argument)
        case ast.ListComp() | ast.SetComp() | ast.GeneratorExp() | ast.DictComp():
            for index, loop in enumerate(node.generators):
                if loop.ifs:
                    bare = ast.comprehension(loop.target, loop.iter, [], loop.is_async)
                    generators = [*node.generators[:index], bare, *node.generators[index + 1 :]]
                    yield ast.unparse(_with_generators(node, generators))
    if isinstance(node, ast.Call):
        for index in range(len(node.keywords)):
            yield ast.unparse(ast.Call(node.func, node.args, [*node.keywords[:index], *node.keywords[index + 1 :]]))


def _of_logic(node: ast.expr) -> Iterator[str]:
    match node:
        case ast.Compare():
            for index, operation in enumerate(node.ops):
                for other in COMPARISONS[type(operation)]:
                    ops = [*node.ops[:index], other, *node.ops[index + 1 :]]
                    yield ast.unparse(ast.Compare(node.left, ops, node.comparators))
        case ast.BoolOp():
            yield ast.unparse(ast.BoolOp(ast.And() if isinstance(node.op, ast.Or) else ast.Or(), node.values))
            for index in range(len(node.values)):
                yield ast.unparse(ast.BoolOp(node.op, [*node.values[:index], *node.values[index + 1 :]]))
        case ast.UnaryOp(op=ast.Not()):
            yield ast.unparse(node.operand)
        case ast.IfExp():
            yield ast.unparse(node.body)
            yield ast.unparse(node.orelse)
        case ast.Constant(value=bool()):
            yield str(not node.value)


def _of_number(node: ast.expr) -> Iterator[str]:
    match node:
        case ast.BinOp() if type(node.op) in OPERATORS:
            yield ast.unparse(ast.BinOp(node.left, OPERATORS[type(node.op)], node.right))
        case ast.UnaryOp(op=ast.USub()):
            yield ast.unparse(node.operand)
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            yield repr(number + 1)
            yield repr(type(number)(0))
        case ast.Attribute(value=ast.Name(id="math"), attr="inf" | "nan"):
            yield "0.0"


def _with_generators(
    node: ast.ListComp | ast.SetComp | ast.GeneratorExp | ast.DictComp, generators: list[ast.comprehension]
) -> ast.expr:
    if isinstance(node, ast.DictComp):
        return ast.DictComp(node.key, node.value, generators)
    return type(node)(node.elt, generators)


if __name__ == "__main__":
    sys.exit(main())

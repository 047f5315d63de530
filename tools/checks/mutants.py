"""Mutants of the safety layer: every single small change of its sources. `tools.checks.breakages` tries them.

The sample is drawn with a seed made from the sources, so that the same sources give the same sample and every change of
them another one.
"""

from __future__ import annotations

import ast
import hashlib
import itertools
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SAFETY = Path("flockd/flight/safety")
FILES = sorted((ROOT / SAFETY).glob("*.py"))

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
        """Its name in `breakages.yaml`; without the line number, which moves."""
        return f"{self.file} {self.place}: {self.changed}"


def sample(mutants: Sequence[Mutant], count: int, seed: str | None = None) -> list[Mutant]:
    """A sample of `count` mutants, or all if there are fewer, in order; `seed`: by default from the sources."""
    seed = seed or hashlib.sha256(b"".join(path.read_bytes() for path in FILES)).hexdigest()[:8]
    chosen = random.Random(seed).sample(range(len(mutants)), min(count, len(mutants)))
    return [mutants[index] for index in sorted(chosen)]


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
    starts = list(itertools.accumulate(map(len, lines), initial=0))
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
_OPPOSED = (("min", "max"), ("any", "all"), ("argmin", "argmax"), ("minimum", "maximum"))
OPPOSITES = {one: other for pair in _OPPOSED for one, other in (pair, pair[::-1])}


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
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and any(ast.unparse(base).endswith("Enum") for base in node.bases):
                targets = [statement.targets[0] for statement in node.body if isinstance(statement, ast.Assign)]
                enums[node.name] = [target.id for target in targets if isinstance(target, ast.Name)]
    return enums


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes of a tree that have an effect when run: no annotations, texts or imports."""
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

"""Deliberate errors in a source file: where one can be made, and what then stands there.

Left out is what cannot matter or what nobody should test: type annotations, docstrings, assertions
(they speak to the type checker), ``__all__``, ``__repr__``, texts of logs and of ``--help``, and
f-strings, whose parts Python 3.11 does not locate.
"""

from __future__ import annotations

import ast
import math
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from operators import OPERATORS

TYPING_CALLS = {"TypeVar", "ParamSpec", "NewType"}
LOGS = re.compile(r"\b(log|logger|logging)\b")


@dataclass(frozen=True)
class Mutant:
    """One error: the bytes from ``start`` to ``end`` of a file become ``new``."""

    path: str  # from the root of the checkout
    line: int
    start: int
    end: int
    new: str

    def applied_to(self, source: bytes) -> bytes:
        return source[: self.start] + self.new.encode() + source[self.end :]

    def describe(self, source: bytes) -> str:
        """The line, or the deleted statement, as it was and as it is."""
        first = source.rfind(b"\n", 0, self.start) + 1
        last = source.find(b"\n", self.end)
        last = len(source) if last < 0 else last
        was = source[first:last].decode()
        now = source[first : self.start].decode() + self.new + source[self.end : last].decode()
        return f"{self.path}:{self.line}: {_short(was)}  ->  {_short(now)}"


def _short(text: str, width: int = 90) -> str:
    text = " ".join(text.split())
    return text if len(text) <= width else text[: width - 3] + "..."


def draw(root: Path, package: str, n: int, seed: int) -> list[Mutant]:
    """Up to ``n`` different errors in the sources of a package, each of which still compiles."""
    found = [
        mutant
        for path in sorted((root / package).rglob("*.py"))
        for mutant in mutants_of(path.relative_to(root).as_posix(), path.read_bytes())
    ]
    drawn: list[Mutant] = []
    for i in np.random.default_rng(seed).permutation(len(found)):
        if len(drawn) == n:
            break
        if _compiles(found[i].applied_to((root / found[i].path).read_bytes())):
            drawn.append(found[i])
    return sorted(drawn, key=lambda mutant: (mutant.path, mutant.start))


def _compiles(source: bytes) -> bool:
    try:
        compile(source, "mutant", "exec")
    except SyntaxError:
        return False
    return True


def mutants_of(path: str, source: bytes) -> list[Mutant]:
    """Every error that can be made in one file."""
    changes = _Changes(path, source)
    changes.visit(ast.parse(source))
    return changes.found


class _Changes(ast.NodeVisitor):
    """Walks through a file and collects the errors that can be made in it."""

    def __init__(self, path: str, source: bytes) -> None:
        self.path, self.source = path, source
        self.found: list[Mutant] = []
        lines = source.splitlines(keepends=True)
        self._line_starts = [0, *np.cumsum([len(line) for line in lines]).tolist()]
        self._assigned: set[str] = set()  # the names that have a value already, in this function

    def _span(self, node: ast.AST) -> tuple[int, int]:
        starts = self._line_starts
        return (
            starts[node.lineno - 1] + node.col_offset,
            starts[node.end_lineno - 1] + node.end_col_offset,
        )

    def _offer(self, line: int, start: int, end: int, new: str) -> None:
        self.found.append(Mutant(self.path, line, start, end, new))

    def _replace(self, node: ast.AST, new: str) -> None:
        self._offer(node.lineno, *self._span(node), new)

    def _swap(self, operator: ast.AST, left: ast.AST, right: ast.AST, suffix: str = "") -> None:
        """Put another operator between two expressions, which may stand in parentheses."""
        old, new = OPERATORS[type(operator)]
        start, end = self._span(left)[1], self._span(right)[0]
        match = re.search((old + suffix).encode(), self.source[start:end])
        if match:
            line = self.source[: start + match.start()].count(b"\n") + 1
            self._offer(line, start + match.start(), start + match.end(), new + suffix)

    def _negate(self, test: ast.expr) -> None:
        if isinstance(test, ast.Name | ast.Attribute | ast.Call | ast.Subscript):
            start = self._span(test)[0]
            self._offer(test.lineno, start, start, "not ")

    def _visit_all(self, nodes: list[ast.AST] | list[ast.expr] | list[ast.stmt]) -> None:
        for node in nodes:
            self.visit(node)

    # --- what is left out -----------------------------------------------------------------------

    def visit_Assert(self, node: ast.Assert) -> None: ...
    def visit_Import(self, node: ast.Import) -> None: ...
    def visit_ImportFrom(self, node: ast.ImportFrom) -> None: ...
    def visit_JoinedStr(self, node: ast.JoinedStr) -> None: ...

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._visit_all(node.body)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if node.name == "__repr__" or any("overload" in ast.dump(d) for d in node.decorator_list):
            return
        outer, self._assigned = self._assigned, {a.arg for a in ast.walk(node.args) if _is_arg(a)}
        self._defaults(node.args)
        self._visit_all([*node.decorator_list, *node.body])
        self._assigned = outer

    def visit_Lambda(self, node: ast.Lambda) -> None:
        self._defaults(node.args)
        self.visit(node.body)

    def _defaults(self, arguments: ast.arguments) -> None:
        for default in [*arguments.defaults, *filter(None, arguments.kw_defaults)]:
            if isinstance(default, ast.Constant) and default.value is None:
                self._replace(default, "0")
            self.visit(default)

    # --- statements -----------------------------------------------------------------------------

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant) or LOGS.search(ast.unparse(node).partition("(")[0]):
            return
        if isinstance(node.value, ast.Call | ast.Yield | ast.YieldFrom):
            self._replace(node, "pass")
        self.visit(node.value)

    def visit_Assign(self, node: ast.Assign) -> None:
        names = {n.id for t in node.targets for n in ast.walk(t) if _is_stored_name(n)}
        if "__all__" in names:
            return
        if names <= self._assigned:
            self._replace(node, "pass")
        self._assigned |= names
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None and "TypeAlias" not in ast.unparse(node.annotation):
            self._assigned |= {node.target.id} if isinstance(node.target, ast.Name) else set()
            self.visit(node.value)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self._replace(node, "pass")
        self._swap(node.op, node.target, node.value, "=")
        self.visit(node.value)

    def visit_For(self, node: ast.For) -> None:
        self._assigned |= {n.id for n in ast.walk(node.target) if _is_stored_name(n)}
        self.generic_visit(node)

    def visit_If(self, node: ast.If) -> None:
        test = ast.unparse(node.test)
        if "TYPE_CHECKING" in test or "verbose" in test:
            self._visit_all(node.orelse)
            return
        if not node.orelse:
            self._replace(node, "pass")
        self._negate(node.test)
        self.generic_visit(node)

    def visit_While(self, node: ast.While) -> None:
        self._negate(node.test)
        self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        self._replace(node, "pass")
        self.generic_visit(node)

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is not None:
            self._replace(node.value, "None")
            self.visit(node.value)

    def visit_Break(self, node: ast.Break) -> None:
        self._replace(node, "continue")

    def visit_Continue(self, node: ast.Continue) -> None:
        self._replace(node, "break")

    # --- expressions ----------------------------------------------------------------------------

    def visit_Compare(self, node: ast.Compare) -> None:
        operands = [node.left, *node.comparators]
        for operator, (left, right) in zip(node.ops, pairwise(operands), strict=True):
            self._swap(operator, left, right)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        for left, right in pairwise(node.values):
            self._swap(node.op, left, right)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        self._swap(node.op, node.left, node.right)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        start = self._span(node)[0]
        match = re.match(rb"not\b\s*|-", self.source[start:])
        if match:
            self._offer(node.lineno, start, start + match.end(), "")
        self.visit(node.operand)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self._negate(node.test)
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        for test in node.ifs:
            self._negate(test)
        self.generic_visit(node)

    def visit_Slice(self, node: ast.Slice) -> None:
        for bound in filter(None, (node.lower, node.upper, node.step)):
            self._replace(bound, "")
            self.visit(bound)

    def visit_Call(self, node: ast.Call) -> None:
        name = ast.unparse(node.func).rpartition(".")[2]
        if name in TYPING_CALLS:
            return
        if name == "range":
            stop = node.args[min(1, len(node.args) - 1)]
            start, end = self._span(stop)
            self._offer(stop.lineno, start, end, f"({self.source[start:end].decode()}) - 1")
        texts = {"help"}
        self.visit(node.func)
        self._visit_all(node.args[1:] if name == "cast" else node.args)
        self._visit_all([word.value for word in node.keywords if word.arg not in texts])

    def visit_Constant(self, node: ast.Constant) -> None:
        self._replace(node, new) if (new := _another(node.value)) else None


def _another(value: object) -> str | None:
    match value:
        case bool():
            return str(not value)
        case int():
            return str(value + 1)
        case float():
            return repr(value + 1 if math.isfinite(value) and value + 1 != value else 0.0)
        case str():
            return '""' if value else '"XX"'
    return None


def _is_arg(node: ast.AST) -> bool:
    return isinstance(node, ast.arg)


def _is_stored_name(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)

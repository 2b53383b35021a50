"""Deliberate errors in a source file: where one can be made, and what then stands there.

Left out is what cannot matter or what nobody should test: annotations, docstrings, assertions (they
speak to the type checker), ``__all__``, ``__repr__``, texts of logs and of help, and f-strings.
"""

from __future__ import annotations

import ast
import copy
import random
import re
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

_SWAPS = """Lt LtE, LtE Lt, Gt GtE, GtE Gt, Eq NotEq, NotEq Eq, Is IsNot, IsNot Is, In NotIn,
NotIn In, And Or, Or And, Add Sub, Sub Add, Mult Div, Div Mult, FloorDiv Div, Mod FloorDiv,
Pow Mult, MatMult Mult, BitAnd BitOr, BitOr BitAnd, BitXor BitAnd, LShift RShift,
RShift LShift"""
SWAPS = dict([getattr(ast, name) for name in pair.split()] for pair in _SWAPS.split(","))
LOGS = re.compile(r"(.*\.)?_?(log|logger|logging)\b")


class Mutant(NamedTuple):
    """One error: what some lines of a file are, and what becomes of them."""

    path: str  # from the root of the checkout
    line: int  # the first of them
    old: str
    new: str

    def applied_to(self, source: str) -> str:
        at = sum(map(len, source.splitlines(keepends=True)[: self.line - 1]))
        return source[:at] + self.new + source[at + len(self.old) :]


def drawn(root: Path, package: str, n: int, seed: int) -> list[Mutant]:
    """Up to ``n`` different errors in the sources of a package."""
    paths = sorted((root / package).rglob("*.py"))
    found = [m for p in paths for m in mutants_of(p.relative_to(root).as_posix(), p.read_text())]
    random.Random(seed).shuffle(found)  # noqa: S311
    return sorted(found[:n])


def mutants_of(path: str, source: str) -> list[Mutant]:
    """Every error that can be made in one file."""
    text, found = source.encode(), []
    starts = [0, *accumulate(map(len, text.splitlines(keepends=True)))]
    for node, new in _changes(ast.parse(source)):
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        first, rest = starts[node.lineno - 1], text[end : starts[node.end_lineno]].rstrip(b"\n")
        old, changed = text[first:end] + rest, text[first:start] + new.encode() + rest
        found.append(Mutant(path, node.lineno, old.decode(), changed.decode()))
    return found


def _changes(node: ast.AST) -> Iterator[tuple[ast.AST, str]]:  # noqa: PLR0912  # by kind
    """Pairs of a node and the text that takes its place, at this node and within it."""
    within = list(ast.iter_child_nodes(node))
    match node:
        case ast.Assert() | ast.Import() | ast.ImportFrom() | ast.JoinedStr():
            return
        case ast.FunctionDef():
            if node.name == "__repr__" or "overload" in map(ast.unparse, node.decorator_list):
                return
            within = [*node.args.defaults, *filter(None, node.args.kw_defaults), *node.body]
        case ast.ClassDef():
            within = node.body
        case ast.Expr():
            if isinstance(node.value, ast.Constant) or LOGS.match(ast.unparse(node)):
                return
            yield node, "pass"
        case ast.Assign(targets=[ast.Name(id="__all__")]):
            return
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]) | ast.Raise():
            yield node, "pass"
        case ast.AnnAssign():
            within = [node.value] if node.value else []
        case ast.AugAssign() | ast.BinOp() | ast.BoolOp():
            yield node, _unparsed(node, op=SWAPS[type(node.op)]())
        case ast.Compare():
            for i, operator in enumerate(node.ops):
                ops = [*node.ops[:i], SWAPS[type(operator)](), *node.ops[i + 1 :]]
                yield node, _unparsed(node, ops=ops)
        case ast.If() if re.search("TYPE_CHECKING|verbose", ast.unparse(node.test)):
            within = node.orelse
        case ast.If() | ast.While() | ast.IfExp():
            yield node.test, f"(not {ast.unparse(node.test)})"
            if isinstance(node, ast.If) and not node.orelse:
                yield node, "pass"
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield node, f"({ast.unparse(node.operand)})"
        case ast.Break() | ast.Continue():
            yield node, "continue" if isinstance(node, ast.Break) else "break"
        case ast.Return(value=ast.expr()):
            yield node.value, "None"
        case ast.Call():
            name = ast.unparse(node.func)
            words = [word.value for word in node.keywords if word.arg != "help"]
            within = [node.func, *node.args[name in {"cast", "TypeVar"} :], *words]
            if name == "range":
                yield node.args[-1], f"({ast.unparse(node.args[-1])}) - 1"
        case ast.Constant(value=bool() as value):
            yield node, str(not value)
        case ast.Constant(value=str() as value):
            yield node, "''" if value else "'XX'"
        case ast.Constant(value=int() | float() as value):
            yield node, repr(value + 1 if value < 1e15 else 0.0)
    for child in within:
        yield from _changes(child)


def _unparsed(node: ast.AST, **changed: object) -> str:
    new = copy.copy(node)
    vars(new).update(changed)
    return ast.unparse(new) if isinstance(node, ast.stmt) else f"({ast.unparse(new)})"

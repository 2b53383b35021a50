"""Excerpts of the project's own source for the pages."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def code_block(path: str, *names: str) -> str:
    """The named definitions of a file, one after another, as a fenced block.

    Args:
        path: of the file, from the root of the repository.
        names: of functions, classes or constants at the top of the module, or ``Class.method``.

    Raises:
        ValueError: if the file defines no such name.
    """
    text = (ROOT / path).read_text(encoding="utf-8")
    pieces = [definition(text, name, path) for name in names]
    return f"`{path}`:\n\n```python\n" + "\n\n\n".join(pieces) + "\n```\n"


def definition(text: str, name: str, path: str) -> str:
    """The lines that define a name, with its decorators, moved to the left margin.

    Raises:
        ValueError: if the text defines no such name.
    """
    body = ast.parse(text).body
    for part in name.split("."):
        found = next((node for node in body if part in defined(node)), None)
        if found is None:
            raise ValueError(f"{path} defines no {name}")
        body = getattr(found, "body", [])
    assert found is not None
    first = min([found.lineno, *(d.lineno for d in getattr(found, "decorator_list", []))])
    lines = text.splitlines()[first - 1 : found.end_lineno]
    margin = len(lines[0]) - len(lines[0].lstrip())
    return "\n".join(line[margin:] for line in lines)


def defined(node: ast.stmt) -> list[str]:
    """The names that a statement binds, for functions, classes and assignments."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else []
    return [target.id for target in targets if isinstance(target, ast.Name)]

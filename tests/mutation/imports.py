"""Which module imports which: where to look first for a test, and what machine code depends on."""

from __future__ import annotations

import ast
from pathlib import Path


class Imports:
    """The imports among the files of a checkout, read from their sources.

    A name that is imported from a package leads to the module of the package that defines it, so
    that packages may load their modules on first use.
    """

    def __init__(self, root: Path, folders: list[str]) -> None:
        paths = sorted(path for folder in folders for path in (root / folder).rglob("*.py"))
        trees = {path.relative_to(root).as_posix(): ast.parse(path.read_bytes()) for path in paths}
        self._modules = {_module(path): path for path in trees}
        self._definitions = {
            (module.partition(".")[0], name): module
            for module, path in self._modules.items()
            for name in _top_level_names(trees[path])
        }
        self._of = {path: self._targets(tree) for path, tree in trees.items()}

    def _targets(self, tree: ast.Module) -> set[str]:
        """The files that a file imports from, at its head or within its functions; and `numba`."""
        names = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names.add(node.module)
                for alias in node.names:
                    names.add(f"{node.module}.{alias.name}")
                    names.add(self._definitions.get((node.module, alias.name), node.module))
        found = {self._modules[name] for name in names if name in self._modules}
        return found | ({"numba"} & names)

    def distances(self, path: str) -> dict[str, int]:
        """How many imports lie between each file that depends on ``path`` and it."""
        return _reach([path], {p: {q for q in self._of if p in self._of[q]} for p in self._of})

    def beneath_machine_code(self) -> set[str]:
        """The files that hold compiled functions, and those that they take anything from."""
        decorators = {path for path, targets in self._of.items() if "numba" in targets}
        compiled = {path for path, targets in self._of.items() if targets & decorators}
        return set(_reach([*decorators, *compiled], self._of))


def _reach(start: list[str], edges: dict[str, set[str]]) -> dict[str, int]:
    distances, layer = dict.fromkeys(start, 0), set(start)
    while layer:
        following = set().union(*(edges.get(path, set()) for path in layer)) - distances.keys()
        distances |= dict.fromkeys(following, 1 + max(distances.values()))
        layer = following
    return distances


def _module(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _top_level_names(tree: ast.Module) -> set[str]:
    names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    values = [node for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)]
    stored = [node for value in values for node in ast.walk(value)]
    return names | {
        n.id for n in stored if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
    }

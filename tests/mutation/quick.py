"""Choose the tests of ``pytest -m quick``: those that may catch most errors per second.

    python tests/mutation --choose-quick 30

All tests run once, watched for the functions that they enter and what they cost. Each function
weighs as much as errors can be made in it (`drawing`). Then the test function is chosen, again and
again, whose functions weigh most per second; with each choice the weight of its functions halves,
as a further test of a function catches fewer new errors. The names go to ``tests/quick.txt``.
"""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

from drawing import mutants_of

# It waits by the clock, which processor time does not tell.
LEFT_OUT = ("test_what_a_killed_worker_has_saved_is_gone_on_with",)


def packages_of(root: Path) -> list[Path]:
    """The folders of a checkout's packages; some have links to them beside them."""
    found = sorted(file.parent for file in root.glob("*/__init__.py"))
    return [folder for folder in found if not folder.is_symlink()]


def weights(root: Path) -> Counter[str]:
    """How many errors can be made in each function, by ``path:line`` as a code object has it."""
    found: Counter[str] = Counter()
    for folder in packages_of(root):
        for file in sorted(folder.rglob("*.py")):
            path, source = file.relative_to(root).as_posix(), file.read_text()
            functions = [
                node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)
            ]
            for mutant in mutants_of(path, source):
                around = [f for f in functions if f.lineno <= mutant.line <= (f.end_lineno or 0)]
                if around:
                    first = [around[-1].lineno, *(d.lineno for d in around[-1].decorator_list)]
                    found[f"{path}:{min(first)}"] += 1
    return found


def chosen(
    costs: dict[str, float], entered: dict[str, set[str]], weight: dict[str, float], seconds: float
) -> list[str]:
    """The names of the test functions, the most valuable first."""
    left, names = dict(weight), []
    rest = {name for name in costs if not name.endswith(LEFT_OUT)}
    while rest:
        worth = {
            name: sum(left.get(place, 0.0) for place in entered[name]) / max(costs[name], 0.01)
            for name in rest
        }
        best = max(sorted(rest), key=lambda name: worth[name])
        if worth[best] == 0:
            break
        rest.discard(best)
        if costs[best] > seconds:
            continue
        seconds -= costs[best]
        names.append(best)
        for place in entered[best] & left.keys():
            left[place] /= 2
    return names

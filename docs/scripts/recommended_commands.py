"""The commands that the project's own text recommends, and the results of their trainings.

The commands are found in README, in the pages, and in docstrings and help texts of the code. A
training is a call of ``train.py`` with such arguments. A comparison stands for one training per
agent and environment, and a search for the training with its first settings.
"""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass, field
from functools import cache
from itertools import product
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "documented-commands.json"
# Where a command ends: a backtick, a comment, a cell of a table or the line.
COMMAND = re.compile(
    r"(?:python (?:~/yardstick/)?(train|compare|tune)\.py|\byardstick (train|compare|tune)"
    r"|\bpython (train)\.py|\b(make train)\b)"
    r"((?:[^\S\n]+(?!#)[^\s`|#]+)*)"
)
TRAIN = "make train"
# Flags that do not affect the training, and their numbers of values; -1: up to the next flag.
OUTPUT = {"--seed": 1, "--engine": 1, "--watch-learning": -1, "--resume-or-start": 0}
OUTPUT |= {"--diagnose": 0}
SEARCH = {"--trials": 1, "--timeout": 1, "-j": 1, "--seeds-per-trial": 1, "--objective": 1}
SEARCH |= {"--sampler": 1, "--name": 1}
SEARCH |= {"--until-decided": 0, "--max-retest-seeds": 1}
STUDY = {"--env": -1, "--algos": -1, "--seeds": 1, "--first-seed": 1}
STUDY |= {"--episodes-table": 1, "--render-every": 1, "--metric": 1, "--figures": -1}
LINE = re.compile(r"^(python (?:train|compare)\.py [^#\n]*?)(?: +#[^\n]*)?$", re.MULTILINE)


@dataclass(frozen=True)
class Command:
    """A command in the text.

    Attributes:
        script: ``"train"``, ``"compare"`` or ``"tune"``.
        words: its arguments.
        places: the files that contain it.
    """

    script: str
    words: tuple[str, ...]
    places: list[str] = field(default_factory=list, compare=False)

    @property
    def trainings(self) -> list[str]:
        """The trainings that it stands for, as arguments of ``train.py``; none for other commands.

        The tests of pages run commands that need the reader's modules or files of runs, and the
        tests of studies run study files. ``train.py`` has no flag ``--as-it-comes``.
        """
        words = list(self.words)
        needs = {"--list", "--resume", "-i", "--gym-packages", "--conf-file", "--logged"}
        needs |= {"--as-it-comes", "--storage"}
        agents = _values(words, "--algo") + _values(words, "--algos")
        is_own = any(":" in agent for agent in agents)
        if is_own or needs & set(words) or "--env" not in words:
            return []
        rest = _without(words, {**OUTPUT, **SEARCH, **STUDY, "--algo": 1})
        pairs = product(_values(words, "--env"), agents)
        return [shlex.join(["--env", env, "--algo", algo, *rest]) for env, algo in pairs]


def _values(words: list[str], flag: str) -> list[str]:
    """The values of a flag, up to the next flag."""
    if flag not in words:
        return []
    rest = words[words.index(flag) + 1 :]
    end = next((i for i, word in enumerate(rest) if word.startswith("-")), len(rest))
    return rest[:end]


def _without(words: list[str], flags: dict[str, int]) -> list[str]:
    """The words without these flags and their values."""
    kept = list(words)
    for flag, n in flags.items():
        while flag in kept:
            at = kept.index(flag)
            del kept[at : at + 1 + (len(_values(kept, flag)) if n < 0 else n)]
    return kept


@cache
def documented() -> tuple[Command, ...]:
    """All distinct commands of the text, in the order in which they are found."""
    pages = [p for p in sorted(ROOT.glob("docs/**/*.md")) if "decisions" not in p.parts]
    code = sorted((ROOT / "rl_yardstick").rglob("*.py"))
    found: dict[Command, Command] = {}
    for path in (ROOT / "README.md", *pages, *sorted(ROOT.glob("*.py")), *code):
        for one in commands_in(path.read_text(encoding="utf-8")):
            place = str(path.relative_to(ROOT))
            same = found.setdefault(one, one)
            same.places.extend([place] * (place not in same.places))
    return tuple(found.values())


def commands_in(text: str) -> list[Command]:
    """The commands of a text that have arguments, or need none."""
    found = []
    for match in COMMAND.finditer(text):
        script = next(filter(None, match.groups()[:4]))
        if script == TRAIN:
            given = re.match(r' ARGS="([^"]+)"', text[match.end(4) :])
            rest = given[1] if given else "--env Warehouse-v0 --algo ppo"
            script = "train"
        else:
            rest = match[5]
        if re.search(r"\{\w+\}", rest):  # a template in the code
            continue
        words = tuple(shlex.split(rest.rstrip(".,;:)")))
        if words:
            found.append(Command(script, words))
    return found


def trainings() -> dict[str, list[str]]:
    """The trainings, each with the files that recommend it."""
    found: dict[str, list[str]] = {}
    for command in documented():
        for training in command.trainings:
            places = found.setdefault(training, [])
            places.extend(place for place in command.places if place not in places)
    return found


@dataclass(frozen=True)
class Reached:
    """The results of a training: the number of runs that solve it, and the median."""

    n_solved: int | None
    n_runs: int
    median: str
    seconds: float


def reached() -> dict[str, Reached]:
    """The results of `benchmarks/documented_commands.py`, by training."""
    found = {}
    for training, row in json.loads(RESULTS.read_text(encoding="utf-8")).items():
        n_solved, _, n_runs = row["solved"].partition(" of ")
        count, n = (int(n_solved), int(n_runs)) if row["solved"] else (None, 0)
        found[training] = Reached(count, n, row["median"], row["seconds"])
    return found


def with_outcomes(text: str) -> str:
    """A page with the result of each command in a code block beside it, as a comment."""
    table = reached()

    def line(found: re.Match[str]) -> str:
        command = commands_in(found[1])[0]
        rows = [table.get(one) for one in command.trainings]
        told = _outcome([row for row in rows if row], command) if all(rows) else ""
        return f"{found[1]}  # {told}" if told else found[0]

    return LINE.sub(line, text)


def _outcome(rows: list[Reached], command: Command) -> str:
    if not rows or any(row.n_solved is None for row in rows):
        return ""
    first = rows[0]
    if first.n_runs == 1:
        return f"score {first.median}"
    of = f"of {first.n_runs} seeds"
    if len({(row.n_solved, row.n_runs) for row in rows}) == 1:
        return f"{'each ' * (len(rows) > 1)}solves {first.n_solved} {of}"
    agents = _values(list(command.words), "--algos")
    told = [f"{row.n_solved} with {agent}" for agent, row in zip(agents, rows, strict=True)]
    return f"solves, {of}: {', '.join(told)}"


if __name__ == "__main__":
    for line, where in trainings().items():
        print(line, "   ", *where)

"""The documents: their commands are accepted as they stand, and do what the page says of them.

And no two pages disagree on a figure that they have in common.
"""

import re
import shlex
import sys
from collections import defaultdict
from pathlib import Path

import pytest

from commands import audit, compare, enjoy, explain, shaping, train, tune
from commands.compare import study_spec
from commands.train import train_spec
from commands.tune import tuning_spec
from experiments.plan import plan
from experiments.study import _STUDY_KEYS, read_study

ROOT = Path(__file__).parent.parent
sys.path += [str(ROOT / "benchmarks"), str(ROOT / "docs" / "scripts")]

from documented_commands import SEEDS, n_solved, outcome, prepared_folder  # noqa: E402

from recommended_commands import (  # noqa: E402
    PAGE,
    commands_in,
    reached,
    trainings,
    with_outcomes,
)

README = (ROOT / "README.md").read_text()
COMPARE = (ROOT / "docs" / "compare.md").read_text()
COMMAND = re.compile(r"python ((?:train|enjoy|compare|tune|explain|shaping|audit)\.py [^`\n)#]*)")
# Each with the first document that it stands in.
FOUND_IN = {
    command.strip(): document.name
    for document in reversed([ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))])
    for command in COMMAND.findall(
        document.read_text().replace("--env\nWarehouse", "--env Warehouse")
    )
}
PARSED_ALONE = {
    "explain.py": explain.build_parser,
    "shaping.py": shaping.build_parser,
    "audit.py": audit.build_parser,
}
COMMANDS = [pytest.param(each, id=f"{name}: {each}") for each, name in FOUND_IN.items()]


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_can_be_carried_out(tmp_path, monkeypatch, command):
    script, *words = shlex.split(command)
    if script == "train.py":
        # What the commands take for granted.
        (tmp_path / "map.txt").write_text("S..\n.#.\n..G\n")
        log = "segment,arm,reward,propensity\ncore,0,1,0.5\ncasual,1,0,0.5\n"
        (tmp_path / "train.csv").write_text(log)
        monkeypatch.chdir(tmp_path)
        args = train.build_parser().parse_args(words)
        args.trained_agent = ""
        assert args.list or train_spec(args).env_id == args.env
    elif script == "enjoy.py":
        args = enjoy.build_parser().parse_args(words)
        assert args.model is not None or args.env == "Warehouse-v0"
    elif script == "tune.py":
        args = tune.build_parser().parse_args(words)
        assert tuning_spec(args).environment.env_id == args.env
    elif script in PARSED_ALONE:  # the runs and modules that they name are examples
        assert vars(PARSED_ALONE[script]().parse_args(words))
    else:
        monkeypatch.chdir(ROOT)
        args = compare.build_parser().parse_args(words)
        assert bool(args.logged) == bool(args.policy)
        study = None if args.logged else study_spec(args)
        if study is not None and "map.txt" not in command:
            assert sum(run.n_runs for run in plan(study, tmp_path)) >= study.n_seeds


def test_there_are_commands_to_check():
    counts = {
        script: sum(command.startswith(script) for command in FOUND_IN)
        for script in ("compare.py", "train.py", "enjoy.py", "tune.py")
    }
    assert counts["compare.py"] >= 20
    assert counts["train.py"] >= 6
    assert min(counts.values()) >= 2


def test_the_readmes_script_prints_what_stands_below_it(capsys):
    code, printed = re.search(r"```python\n(.*?)```\n\n```\n(.*?)```", README, re.DOTALL).groups()
    exec(code, {})  # noqa: S102  # a page of this project
    assert capsys.readouterr().out == printed


def test_what_the_readme_and_the_page_on_compare_point_to_is_there():
    for text, folder in ((README, ROOT), (COMPARE, ROOT / "docs")):
        targets = re.findall(r"\]\(([^)#\s]+)(?: \"[^\"]*\")?\)", text) + re.findall(
            r'src="([^"]+)"', text
        )
        files = [target for target in targets if not target.startswith("http")]
        assert len(files) >= 4
        assert [name for name in files if not (folder / name).exists()] == []
    targets = set(re.findall(r"\bmake ([a-z]+)", README))
    assert targets == {"train", "test", "docs", "bench"}
    makefile = (ROOT / "Makefile").read_text()
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)


def test_the_example_of_a_study_is_one_and_every_key_is_documented(tmp_path):
    (example,) = re.findall(r"```yaml\n(.*?)```", COMPARE, re.DOTALL)
    path = tmp_path / "example.yml"
    path.write_text(example)
    study = read_study(path)
    assert [agent.label for agent in study.agents] == [
        *(f"qlearning with α = {value}" for value in (0.01, 0.1, 0.9)),
        "careful",
    ]
    assert len(plan(study, tmp_path)) == 4 * 2 * 20
    assert len(plan(study.quickened(), tmp_path)) == 4 * 2 * 3
    table = COMPARE.partition("| key | meaning |")[2].partition("\n\n")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert sorted(re.findall(r"`(\w+)`", " ".join(rows))) == sorted(_STUDY_KEYS)


# --- what the commands reach ----------------------------------------------------------------------

ENOUGH = 0.25  # seconds of processor time: trainings that take less are done as they stand
TASTE = 300  # steps of the others


def test_every_training_that_the_text_recommends_has_its_row():
    """Otherwise: python benchmarks/documented_commands.py --fill."""
    assert set(trainings()) == set(reached())
    assert len(trainings()) > 70
    pages = [path for path in sorted(ROOT.glob("docs/**/*.md")) if path != PAGE]
    told = [path.name for path in pages if "seeds\n" in with_outcomes(path.read_text())]
    assert len(told) > 30
    assert [p.name for p in pages if with_outcomes(p.read_text()) != p.read_text()] == []


@pytest.mark.parametrize("training", trainings())
def test_each_training_does_what_the_page_says(tmp_path, monkeypatch, training):
    """Those that are cheap and always succeed, with the first seed; a taste of the others."""
    monkeypatch.chdir(tmp_path)
    prepared_folder(tmp_path)
    row = reached()[training]
    if row.seconds <= ENOUGH and row.n_solved == row.n_runs:
        assert n_solved(training, [outcome(training, SEEDS[0], tmp_path / "logs")]) == 1
    else:
        words = re.sub(r" (-n|--n-episodes|--eval-freq) \S+", "", training)
        taste = f"{words} -n {TASTE} --eval-freq -1"
        assert outcome(taste, SEEDS[0], tmp_path / "logs")["seconds"] >= 0


def test_the_collector_reads_commands_wherever_they_stand():
    text = """
    | row | `python train.py --env A-v0 --algo x --seed 3 -params gamma:0.9` | more |
    ``make train ARGS="--env B-v0 --algo y --engine auto"`` and `make train`
    python train.py --list
    python compare.py --env A-v0 B-v0 --algos x y --seeds 5 --env-kwargs slip:0.1   # a comment
    python tune.py --env A-v0 --algo x --trials 9
    python compare.py studies/some.yml
    """
    found = [one for command in commands_in(text) for one in command.trainings]
    assert found == [
        "--env A-v0 --algo x -params gamma:0.9",
        "--env B-v0 --algo y",
        "--env Warehouse-v0 --algo ppo",
        *(f"--env {e} --algo {a} --env-kwargs slip:0.1" for e in ("A-v0", "B-v0") for a in "xy"),
        "--env A-v0 --algo x",
    ]


# --- one quantity, one figure ---------------------------------------------------------------------

HEADLINE_PAGES = ("README.md", "docs/library-vs-hand-rolled.md")
TABLES_PAGE = "docs/environments.md"  # two agents on many environments, medians
# Pages that print what a comparison on the seeds from 1000 on says, and its environment.
OUTPUTS = {"docs/compare.md": "CliffWalking-v1", "docs/start.md": "FrozenLake8x8-v1"}
SCORE = re.compile(r"\**(\d\.\d+|\d)\**(?= |$)")
FAILED = re.compile(r"(\d+) of \d+ (?:runs of \w+ )?failed")
# Figures that are known to be of an earlier version, by environment and agent.
STALE = {("FrozenLake8x8-v1", "sarsa"): "the shipped settings are others since"}


def cells(table):
    """The cells of a Markdown table, by the headings of its row and of its column."""
    lines = [line for line in table.splitlines() if line.startswith("|")]
    (_, *headings), _, *rows = (
        [cell.strip(" `†") for cell in line.strip("|").split("|")] for line in lines
    )
    return {
        (name, heading): cell
        for name, *row in rows
        for heading, cell in zip(headings, row, strict=True)
    }


def figures():
    """What pages say of an agent on an environment with seeds from 1000 on, by quantity."""
    found = defaultdict(dict)

    def note(page, environment, agent, cell, statistic, n_seeds=10):
        place = (environment, agent)
        found[f"{statistic} of {n_seeds}", *place][page] = float(SCORE.match(cell)[1])
        failed = FAILED.search(cell)
        found[f"failed of {n_seeds}", *place][page] = int(failed[1]) if failed else 0

    for page in HEADLINE_PAGES:
        text = (ROOT / page).read_text()
        (block,) = re.findall(r"<!-- headline: held-out -->\n(.*?)<!-- end -->", text, re.DOTALL)
        (n_seeds,) = re.findall(r"\?: (\d+) seeds do not show", block)
        for (agent, environment), cell in cells(block).items():
            found["cell", environment, agent][page] = cell
            if page == "README.md":
                note(page, environment, agent, cell, "mean", n_seeds)
    text = (ROOT / TABLES_PAGE).read_text()
    assert "--first-seed 1000" in text
    table = text[text.index("| | `qlearning`") :].partition("\n\n")[0]
    for (environment, agent), cell in cells(table).items():
        note(TABLES_PAGE, environment, agent, cell, "median")
    for page, environment in OUTPUTS.items():
        said = re.search(
            rf"--env {environment} [^\n]*--first-seed 1000.*?```\n(\w.*?\.)\n",
            (ROOT / page).read_text(),
            re.DOTALL,
        )[1]
        for agent, score in re.findall(r"(\w+) \(score ([\d.]+) \[", said):
            failed = re.search(rf"\d+ of 10 runs of {agent} failed", said)
            note(page, environment, agent, f"{score} {failed[0] if failed else ''}", "mean")
    return found


FIGURES = figures()
SHARED = {what: pages for what, pages in FIGURES.items() if len(pages) > 1}


def test_pages_share_figures():
    pages = {page for shared in SHARED.values() for page in shared}
    assert pages >= {*HEADLINE_PAGES, TABLES_PAGE, "docs/compare.md"}
    assert len(SHARED) >= 37


@pytest.mark.parametrize("what", SHARED, ids=" ".join)
def test_no_two_pages_disagree_on_a_figure(what):
    """Scores to the digits of the coarser page; processor times within one study alone."""
    by_page = SHARED[what]
    first, *others = by_page.values()
    for value in others:
        assert value == (first if what[0] == "cell" else pytest.approx(first, abs=1.01e-3)), by_page


# What both pages have with the shipped settings: the median of the ten seeds from 1000 on, and how
# many of the 20 from there on solve it.
COUNTED = {
    tuple(place): (pages[TABLES_PAGE], reached()[training])
    for (statistic, *place), pages in FIGURES.items()
    if statistic == "median of 10" and TABLES_PAGE in pages
    if (training := "--env {} --algo {}".format(*place)) in reached()
    if reached()[training].n_runs == 20 and "return" not in reached()[training].median
}


@pytest.mark.parametrize("place", COUNTED, ids=" ".join)
def test_a_median_of_ten_seeds_fits_how_many_of_20_solve_it(place):
    median, row = COUNTED[place]
    least, most = (5, 20) if median >= 0.9 else (0, 15)
    assert (least <= row.n_solved <= most) is (place not in STALE)

"""The commands in the documents: each is accepted as it stands, and what it names exists."""

import re
import shlex
import sys
from pathlib import Path

import pytest

from commands import compare, enjoy, train, tune
from commands.compare import study_spec
from commands.train import train_spec
from commands.tune import tuning_spec

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

DOCUMENTS = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
COMMAND = re.compile(r"python ((?:train|enjoy|compare|tune)\.py [^`\n)#]*)")


def commands(script):
    found = [
        (document.name, command.strip())
        for document in DOCUMENTS
        for command in COMMAND.findall(
            document.read_text().replace("--env\nWarehouse", "--env Warehouse")
        )
    ]
    return [item for item in dict.fromkeys(found) if item[1].startswith(script)]


def arguments(command):
    return shlex.split(command)[1:]


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A folder that holds what the commands take for granted."""
    (tmp_path / "map.txt").write_text("S..\n.#.\n..G\n")
    log = "segment,arm,reward,propensity\ncore,0,1,0.5\ncasual,1,0,0.5\n"
    (tmp_path / "train.csv").write_text(log)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("document", "command"), commands("train.py"))
def test_train_commands_can_be_carried_out(checkout, document, command):
    parser = train.build_parser()
    args = parser.parse_args(arguments(command))
    if args.list:
        return
    args.trained_agent = ""
    spec = train_spec(args)
    assert spec.env_id == args.env


@pytest.mark.parametrize(("document", "command"), commands("enjoy.py"))
def test_enjoy_commands_are_accepted(document, command):
    args = enjoy.build_parser().parse_args(arguments(command))
    assert args.model is not None or args.env == "Warehouse-v0"


@pytest.mark.parametrize(("document", "command"), commands("compare.py"))
def test_compare_commands_are_accepted(monkeypatch, document, command):
    monkeypatch.chdir(ROOT)
    args = compare.build_parser().parse_args(arguments(command))
    assert bool(args.logged) == bool(args.policy)
    if not args.logged:
        assert study_spec(args).agents


@pytest.mark.parametrize(("document", "command"), commands("tune.py"))
def test_tune_commands_are_accepted(document, command):
    args = tune.build_parser().parse_args(arguments(command))
    assert tuning_spec(args).environment.env_id == args.env


def test_there_are_commands_to_check():
    assert len(commands("compare.py")) >= 20
    assert len(commands("train.py")) >= 6
    assert len(commands("enjoy.py")) >= 2


def test_the_readmes_script_prints_what_stands_below_it(capsys):
    text = (ROOT / "README.md").read_text()
    (code, printed) = re.search(r"```python\n(.*?)```\n\n```\n(.*?)```", text, re.DOTALL).groups()
    exec(code, {})  # noqa: S102  # a page of this project
    assert capsys.readouterr().out == printed


def test_what_the_readme_points_to_is_there():
    text = (ROOT / "README.md").read_text()
    targets = re.findall(r"\]\(([^)#]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    files = [target for target in targets if not target.startswith("http")]
    assert len(files) >= 4
    assert [name for name in files if not (ROOT / name).exists()] == []


def test_make_targets_of_the_readme_exist():
    targets = set(re.findall(r"\bmake ([a-z]+)", (ROOT / "README.md").read_text()))
    assert targets == {"train", "test", "docs", "bench"}
    makefile = (ROOT / "Makefile").read_text()
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)


# --- what the commands reach ---------------------------------------------------------------------

ENOUGH = 0.25  # seconds of processor time: trainings that take less are done as they stand
TASTE = 300  # steps of the others


def test_every_training_that_the_text_recommends_has_its_row():
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

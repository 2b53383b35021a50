"""The documents: their commands are accepted as they stand, and do what the page says of them."""

import importlib
import re
import shlex
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rl_yardstick.commands.compare import study_spec
from rl_yardstick.commands.train import spec_from_flags
from rl_yardstick.commands.tune import tuning_spec
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.study import _File, read_study

ROOT = Path(__file__).parent.parent
sys.path += [str(ROOT / "benchmarks"), str(ROOT / "docs" / "scripts")]

from documented_commands import SEEDS, n_solved, outcome, prepared_folder  # noqa: E402

from recommended_commands import reached, trainings, with_outcomes  # noqa: E402

README = (ROOT / "README.md").read_text()
COMPARE = (ROOT / "docs" / "compare.md").read_text()
SCRIPTS = ("train.py", "enjoy.py", "compare.py", "tune.py")
OTHERS = ("explain", "rate", "shaping", "audit", "check-env")
FIRST = "|".join([*map(re.escape, SCRIPTS), *(f"-m rl_yardstick {name}" for name in OTHERS)])
COMMAND = re.compile(rf"python ((?:{FIRST}) [^`\n)#]*)")
# Each with the first document that it stands in.
FOUND_IN = {
    command.strip(): document.name
    for document in reversed([ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))])
    for command in COMMAND.findall(document.read_text().replace("--env\nWare", "--env Ware"))
}
COMMANDS = [pytest.param(each, id=f"{name}: {each}") for each, name in FOUND_IN.items()]


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_can_be_carried_out(tmp_path, monkeypatch, command):
    script, *words = shlex.split(command.removeprefix("-m rl_yardstick "))
    # What the commands take for granted.
    (tmp_path / "map.txt").write_text("S..\n.#.\n..G\n")
    log = "segment,arm,reward,propensity\ncore,0,1,0.5\ncasual,1,0,0.5\n"
    (tmp_path / "train.csv").write_text(log)
    monkeypatch.chdir(ROOT if script == "compare.py" else tmp_path)
    name = script.removesuffix(".py").replace("-", "_")
    module = importlib.import_module(f"rl_yardstick.commands.{name}")
    args = module.build_parser().parse_args(words)
    if script == "train.py":
        args.trained_agent = ""
        assert args.list or spec_from_flags(args).env_id == args.env
    elif script == "enjoy.py":
        assert args.model is not None or args.env == "Warehouse-v0"
    elif script == "tune.py":
        assert tuning_spec(args).environment.env_id == args.env
    elif script == "compare.py":
        assert bool(args.logged) == bool(args.policy)
        if not args.logged:
            study = study_spec(args)
            if "map.txt" not in command:
                assert sum(run.n_runs for run in plan(study, tmp_path)) >= study.n_seeds


def test_there_are_commands_to_check():
    counts = Counter(command.removeprefix("-m rl_yardstick ").split()[0] for command in FOUND_IN)
    assert counts["compare.py"] >= 20
    assert all(counts[script] for script in (*SCRIPTS, *OTHERS))
    assert len(SAMPLE) > 10


def test_the_readmes_script_prints_what_stands_below_it(capsys):
    code, printed = re.search(r"```python\n(.*?)```\n\n```\n(.*?)```", README, re.DOTALL).groups()
    exec(code, {})  # noqa: S102  # a page of this project
    assert capsys.readouterr().out == printed


def test_what_the_readme_and_the_page_on_compare_point_to_is_there():
    for text, folder in ((README, ROOT), (COMPARE, ROOT / "docs")):
        targets = re.findall(r"\]\(([^)#\s]+)(?: \"[^\"]*\")?\)", text)
        targets += re.findall(r'src="([^"]+)"', text)
        files = [target for target in targets if not target.startswith("http")]
        assert len(files) >= 4
        assert [name for name in files if not (folder / name).exists()] == []
    targets = set(re.findall(r"\bmake ([a-z]+)", README))
    assert targets == {"train", "test", "docs"}
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
    assert sorted(re.findall(r"`(\w+)`", " ".join(rows))) == sorted(_File.model_fields)


# Those that take little processor time and always succeed; of each algorithm the first one.
SECONDS = 0.25
ROWS = reached()
SURE = [
    one
    for one in trainings()
    if (row := ROWS.get(one)) and row.seconds <= SECONDS and row.n_solved == row.n_runs
]
SAMPLE = list({re.search(r"--algo (\S+)", one)[1]: one for one in reversed(SURE)}.values())


def test_every_training_that_the_text_recommends_has_its_row():
    """Otherwise: python benchmarks/documented_commands.py --fill."""
    assert set(trainings()) == set(ROWS)
    assert len(trainings()) > 70
    pages = sorted(ROOT.glob("docs/**/*.md"))
    told = [path.name for path in pages if "seeds\n" in with_outcomes(path.read_text())]
    assert len(told) > 30
    assert [p.name for p in pages if with_outcomes(p.read_text()) != p.read_text()] == []


@pytest.mark.parametrize("training", SAMPLE)
def test_a_training_does_what_the_page_says(tmp_path, monkeypatch, training):
    monkeypatch.chdir(tmp_path)
    prepared_folder(tmp_path)
    assert n_solved(training, [outcome(training, SEEDS[0], tmp_path / "logs")]) == 1


def test_the_headline_table_and_the_picture_are_of_the_published_runs():
    page = (ROOT / "docs" / "library-vs-hand-rolled.md").read_text()
    runs = pd.read_csv(ROOT / "docs" / "measured" / "held-out.csv")
    found = runs.groupby(["agent", "environment"])
    pairs = sorted(zip(found["score"].mean(), found["failed"].sum(), strict=True))
    cells = re.findall(r"\| \W*([\d.]+)\S*(?: ± \S+)? \(\S+ s\)(?:, (\d+) of)?", page)
    told = sorted((float(mean), int(n or 0)) for mean, n in cells)
    assert np.array(told) == pytest.approx(np.array(pairs), abs=2e-4)
    picture = (ROOT / "docs" / "images" / "dots.svg").read_text()
    assert picture.count("of 30 failed") == sum(n > 0 for _, n in pairs)
    assert picture.count("h0") == len(runs) + 2  # those of the legend

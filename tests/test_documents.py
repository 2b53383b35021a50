"""The commands in the documents: each is accepted as it stands, and what it names exists."""

import re
import shlex
from pathlib import Path

import pytest

from commands import compare_agents, enjoy_agent, train_agent, tune_flags
from commands.study_request import study_spec
from commands.train_request import train_spec
from commands.tune_request import tuning_spec

ROOT = Path(__file__).parent.parent
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
    parser = train_agent.build_parser()
    args = parser.parse_args(arguments(command))
    if args.list:
        return
    args.trained_agent = ""
    spec = train_spec(args)
    assert spec.env_id == args.env


@pytest.mark.parametrize(("document", "command"), commands("enjoy.py"))
def test_enjoy_commands_are_accepted(document, command):
    args = enjoy_agent.build_parser().parse_args(arguments(command))
    assert args.model is not None or args.env == "Warehouse-v0"


@pytest.mark.parametrize(("document", "command"), commands("compare.py"))
def test_compare_commands_are_accepted(monkeypatch, document, command):
    monkeypatch.chdir(ROOT)
    args = compare_agents.build_parser().parse_args(arguments(command))
    assert bool(args.logged) == bool(args.policy)
    if not args.logged:
        assert study_spec(args).agents


@pytest.mark.parametrize(("document", "command"), commands("tune.py"))
def test_tune_commands_are_accepted(document, command):
    args = tune_flags.build_parser().parse_args(arguments(command))
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

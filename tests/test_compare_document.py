"""docs/compare.md: its commands are accepted, its example is read, its tables are complete."""

import re
import shlex
from pathlib import Path

import pytest

from commands.compare import build_parser, study_spec
from experiments.plan import plan
from experiments.study import _QUICK_VALUES, _STUDY_KEYS, read_study

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "docs" / "compare.md").read_text()
COMMANDS = re.findall(r"^python compare\.py (.*)$", TEXT, re.MULTILINE)


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_can_be_carried_out(monkeypatch, tmp_path, command):
    monkeypatch.chdir(ROOT)
    study = study_spec(build_parser().parse_args(shlex.split(command, comments=True)))
    assert len(plan(study, tmp_path)) >= study.n_seeds


def test_the_example_is_a_study(tmp_path):
    (example,) = blocks("yaml")
    path = tmp_path / "example.yml"
    path.write_text(example)
    study = read_study(path)
    assert [agent.label for agent in study.agents] == [
        "qlearning with α = 0.01",
        "qlearning with α = 0.1",
        "qlearning with α = 0.9",
        "careful",
    ]
    assert len(plan(study, tmp_path)) == 4 * 2 * 20
    assert len(plan(study.quickened(), tmp_path)) == 4 * 2 * 3


def test_every_key_is_documented():
    table = TEXT.partition("| key | meaning |")[2].partition("\n\n")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert sorted(re.findall(r"`(\w+)`", " ".join(rows))) == sorted(_STUDY_KEYS)
    assert set(_QUICK_VALUES) == {"seeds", "budget"}


def test_links_lead_somewhere():
    targets = re.findall(r"\]\(([^)#]+)\)", TEXT)
    assert targets
    assert all((ROOT / "docs" / target).exists() for target in targets)

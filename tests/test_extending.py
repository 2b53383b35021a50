"""Agents and environments of one's own, as pages write them."""

import json
import re
import shlex
from pathlib import Path

import gymnasium as gym
import pytest

from rl_yardstick.envs import published_models

DOCS = Path(__file__).parents[1] / "docs"
DOCUMENT = (DOCS / "extending.md").read_text() + (DOCS / "own-agent.md").read_text()
FILES = re.findall(r"^`(\w+\.\w+)`[^\n]*(?:\n[^\n]+)*\n\n```\w+\n(.*?)```", DOCUMENT, re.M | re.S)
CHECK = re.findall(r"```python\n((?:(?!```).)*model_check.*?)```", DOCUMENT, re.S)
CONTRIBUTING = (DOCS.parent / "CONTRIBUTING.md").read_text()
COMMANDS = re.findall(r"^python ~/yardstick/(.*)$", DOCUMENT, re.M)


@pytest.mark.usefixtures("in_this_process", "quick_runs")
def test_the_document_can_be_followed(typed, own_folder, monkeypatch):
    monkeypatch.setattr("rl_yardstick.pipeline.evaluation.sampled.STEPS_AT_FIRST", 200)
    for name, text in FILES:
        (own_folder / name).write_text(text)
    assert len(FILES) >= 6
    assert len(COMMANDS) >= 8
    for command in COMMANDS:
        # The comparison with PPO takes a minute as it stands.
        short = command.replace("-n 100000 --seeds 10", "-n 1000 --seeds 2 --no-report")
        out = typed.done(*shlex.split(short))
        if "--algo cautious" in command:  # as the page says of it; its state can be kept
            assert "   return -15 of -13 (gap 2)   success 100 %" in out
            assert "no state can be kept" not in out
    assert gym.make("my/Corridor-v0").unwrapped.length == 6
    logs = own_folder / "logs"
    assert len(list(logs.glob("studies/*/runs/*/my-Corridor-v0_*/run.json"))) == 8


def test_a_model_can_be_checked_as_written(own_folder, monkeypatch, capsys):
    for name, text in FILES:
        (own_folder / name).write_text(text)
    monkeypatch.syspath_prepend(own_folder)
    (code,) = CHECK
    exec(code, {})  # noqa: S102  # a page of this project
    assert capsys.readouterr().out.split() == ["None", "True"]
    # The page's table with an error in it: the slip is not in the model.
    changed = code.replace("check = ", "my_known_corridor.KnownCorridor.step = slipping\ncheck = ")

    def slipping(self, action):
        self.s = min(self.s + int(action), self.observation_space.n - 1)
        return self.s, -1.0, self.s == self.observation_space.n - 1, False, {}

    published_models._checks.clear()  # of the class as it was
    exec(changed, {"slipping": slipping})  # noqa: S102
    assert capsys.readouterr().out.startswith("the environment's P is not what step does: state ")


def test_a_rule_is_one_file(own_folder, typed):
    form = r'```python\n("""Cautious Q-learning\."""\n.*?)```'
    (rule,) = re.findall(form, CONTRIBUTING, re.DOTALL)
    entry = '"cautious", "cautious:CautiousQLearning", observations="Discrete", actions="Discrete"'
    text = f"{rule}\n\nfrom rl_yardstick import agents\n\nagents.register({entry})\n"
    (own_folder / "cautious.py").write_text(text)
    words = ["--env", "FrozenLake-v1", "--algo", "cautious", "-n", "300", "-params", "caution:0.3"]
    command = ["train.py", "--gym-packages", "cautious", "--seed", "0", *words]
    assert typed(*command)[::2] == (0, "")
    (path,) = Path("logs").glob("*/*/run.json")
    record = json.loads(path.read_text())
    assert record["final"]["exact"]
    assert record["engine"] == "compiled"
    assert record["spec"]["algorithm"]["caution"] == 0.3
    # A wrong value of its setting is refused in a line.
    assert "caution" in typed.refused(*command[:-1], "caution:2")

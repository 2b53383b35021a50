"""What commands answer: by which name, to mistakes, and what they say before they load much."""

import os
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LAKE = ["--algo", "qlearning", "--env", "FrozenLake-v1"]


# --- mistakes: one line, code 2, and nothing is left -------------------------------------------

FILES = {
    "broken.yml": "FrozenLake-v1:\n  gamma: [1\n  policy: x\n",
    "plain.yml": "CliffWalking-v1: {n_timesteps: 10, policy: ActionTablePolicy}\n",
    "bad.yml": "agents: {qlearning: {gamma: 2}}\nenvironments: [FrozenLake-v1]\nn_timesteps: 9\n",
    "odd.yml": "default: {train_env_kwargs.maxx_episode_steps: [5, 50]}\n",
    "taken/qlearning": "a file is in the way",
}
LAKE_WORDS = "--algo qlearning --env FrozenLake-v1"
QUICK = f"train.py {LAKE_WORDS} --seed 0 -n 500"
TUNE = f"tune.py {LAKE_WORDS}"
OPTIMAL = "train.py --algo optimal --env CliffWalking-v1 --seed 0"
RUN = "qlearning on FrozenLake-v1, seed 0, 500 steps"
SEARCH = "qlearning on FrozenLake-v1: a search for settings"
PLAIN = "optimal on CliffWalking-v1, seed 0, 10 steps"
# Which words refuse what is recorded in ``tests/golden``; here, that it is said before anything.
MISTAKES = [
    ("train.py --algo qlerning", "unknown agent 'qlerning': did you mean 'qlearning'?"),
    (f"{QUICK} --conf-file broken.yml", "broken.yml:3:9: "),
    ("enjoy.py --algo dqn --env CartPole-v1",
     "train one with: python train.py --algo dqn --env CartPole-v1"),
    ("compare.py --env MountainCarContinuous-v0 --algos sarsa", "does not fit"),
    (f"{TUNE} --storage redis://u:secret@h", "--storage: 'redis://u:***@h' is no"),
]  # fmt: skip
# What only the libraries can tell comes after the line that is printed before they are loaded.
LATE = [
    (f"{QUICK} -params learning_rat:0.1", RUN, "did you mean 'learning_rate'?"),
    (f"{QUICK} -f taken", RUN, "cannot make a run folder in taken/qlearning"),
    (f"{TUNE} --search-space odd.yml", SEARCH, "'maxx_episode_steps': did you mean"),
    (f"{OPTIMAL} --conf-file plain.yml", PLAIN, "needs a time limit"),
    ("compare.py bad.yml", "bad", "bad.yml:1: qlearning: gamma"),
]
CASES = [*((line, "", complaint) for line, complaint in MISTAKES), *LATE]


@pytest.mark.parametrize(
    ("line", "head", "complaint"),
    CASES,
    ids=[line for line, *_ in CASES],
)
def test_one_line_and_nothing_left(type_in_own_folder, own_folder, line, head, complaint):
    for name, text in FILES.items():
        (own_folder / name).parent.mkdir(exist_ok=True)
        (own_folder / name).write_text(text)
    before = sorted(own_folder.rglob("*"))
    code, out, err = type_in_own_folder(*line.split())
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith(f"{line.split()[0]}: error: ")
    assert complaint in err
    assert "secret" not in err
    assert out.partition("\n")[0] == head
    assert sorted(own_folder.rglob("*")) == before


def test_what_is_not_installed_is_named_beforehand(type_in_own_folder, own_folder, monkeypatch):
    # What a machine has without the packages that are optional.
    monkeypatch.setattr("importlib.util.find_spec", lambda *_: None)
    told = "train.py: error: -tb needs: pip install 'rl-yardstick[tensorboard]'\n"
    assert type_in_own_folder(*QUICK.split(), "-tb", "curves") == (2, "", told)
    assert not list(own_folder.iterdir())


# --- by which name the commands are called, and call each other ---------------------------------


def test_training_by_the_installed_name(type_command, tmp_path):
    words = [*LAKE, "--seed", "0", "-n", "500"]
    code, out, err = type_command("/venv/bin/yardstick", "train", *words)
    assert (code, err) == (0, "")
    assert "watch    yardstick enjoy --algo qlearning --env FrozenLake-v1\n" in out
    assert "explain  yardstick explain --algo qlearning --env FrozenLake-v1\n" in out
    assert max(map(len, out.splitlines())) <= 100
    run = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    written = (run / "FrozenLake-v1" / "command.txt").read_text()
    assert written == f"yardstick train {shlex.join(words)}\n"


KNOWN = "train, enjoy, explain, shaping, compare, tune, audit, pack, inspect"


def test_mistakes_name_the_installed_command(type_command):
    for words, said in (
        ("enjoy --algo dqn --env CartPole-v1", " enjoy: error: no run of dqn on CartPole-v1 in "),
        ("x", f": error: unknown command 'x': known are {KNOWN} (see --help)\n"),
    ):
        code, out, err = type_command("yardstick", *words.split())
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith(f"yardstick{said}")
    assert type_command("yardstick", "--version") == (0, f"{version('rl-yardstick')}\n", "")


# --- what is said before anything heavy is loaded -----------------------------------------------

QUICKLY = ("train --help", "train --list", "compare --help", "enjoy --algo ppo --env CartPole-v1")
PROGRAM = """
import sys
from rl_yardstick.commands import main

class Heavy:
    def find_spec(self, name, path=None, target=None):
        assert name not in ("torch", "numba", "stable_baselines3", "pandas", "scipy", "matplotlib")

sys.meta_path.insert(0, Heavy())
for line in sys.argv[1:]:
    sys.argv = ["yardstick", *line.split()]
    try:
        main()
    except SystemExit as stop:
        print("ANSWER", stop.code)
"""


def test_answers_before_anything_heavy_is_loaded(tmp_path):
    words = [sys.executable, "-c", PROGRAM, *QUICKLY]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, cwd=tmp_path, env=env, capture_output=True, text=True, check=True)
    codes = [line for line in done.stdout.splitlines() if line.startswith("ANSWER ")]
    assert codes == ["ANSWER 0"] * 3 + ["ANSWER 2"]

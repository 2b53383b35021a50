"""What people bring works, or one line says why: a command for each case, as a user types it."""

import itertools
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import optuna
import pytest
import yaml
from optuna.storages.journal import JournalFileBackend, JournalStorage

from rl_yardstick.agents import ALGORITHMS, load_algorithm

HERE, ROOT = Path(__file__).parent, Path(__file__).parents[2]
BINS = "rl_yardstick.envs.wrappers.DiscretizeObservation"
SHORT = ("-n", "2000", "--seed", "0")
STRANGE = yaml.safe_load((HERE / "strange_environments.yml").read_text(encoding="utf-8"))


@pytest.fixture
def train(type_in_own_folder, own_folder):
    """Train on one of the strange environments: exit code, output, errors."""
    (own_folder / "strange.py").write_bytes((HERE / "strange_environments.py").read_bytes())

    def run(env, *words, algo="qlearning"):
        choice = ("--gym-packages", "strange", "--env", f"{env}-v0", "--algo", algo)
        return type_in_own_folder("train.py", *choice, *SHORT, *words)

    return run


@pytest.mark.parametrize(("env", "algo", "said"), STRANGE["refused"])
def test_what_nothing_can_learn_on_is_refused(train, own_folder, env, algo, said):
    code, out, err = train(env, algo=algo)
    assert (code, err.count("\n")) == (2, 1), out + err
    assert said in err
    assert not (own_folder / "logs").exists()


@pytest.mark.filterwarnings("ignore:.*WARN.*:UserWarning")  # Gymnasium's own
@pytest.mark.parametrize(("env", "algo", "said"), STRANGE["noted"])
def test_what_is_odd_is_said_once(train, own_folder, env, algo, said):
    code, out, err = train(env, *(["-params", "n_steps:64"] if algo == "ppo" else []), algo=algo)
    assert (code, out.count(said)) == (0, 1), out + err
    (record,) = own_folder.glob("logs/*/*/run.json")
    assert said in json.loads(record.read_text())["notes"][0]


def test_a_wrapper_of_ours_fits_and_is_named_to_be_typed(train):
    code, _, err = train("Vector")
    assert (code, err.count("\n")) == (2, 1)
    assert BINS in err
    code, out, err = train("Vector", *shlex.split(err.partition("add ")[2]))
    assert (code, err) == (0, ""), err
    assert "return -4 " in out
    assert "note:" not in out


NUMBERED = {
    "FromOne": "observations: Discrete(5, start=1) as 5 rows",
    "Pair": "observations: Tuple(Discrete(5), Discrete(2)) as 10 rows",
    "Many": "observations: MultiDiscrete([5 2]) as 10 rows",
    "Named": "observations: Dict(at: Discrete(5), on: Discrete(2)) as 10 rows",
}


@pytest.mark.parametrize("env", NUMBERED)
def test_finite_spaces_are_numbered(train, env):
    code, out, err = train(env)
    assert (code, err) == (0, ""), err
    assert out.count(NUMBERED[env]) == 1
    assert "return -4 " in out


def test_the_grid_world_of_gymnasium_is_solved(train, type_in_own_folder, own_folder):
    """Its zip plays in plain Stable-Baselines3, from every start to every target."""
    code, out, err = train("GridWorld", "-n", "20000")
    assert (code, err) == (0, ""), err
    assert "observations: Dict(agent: Box(2), target: Box(2)) as 625 rows" in out
    (path,) = own_folder.glob("logs/qlearning/*/GridWorld-v0.zip")
    words = ("--gym-packages", "strange", "--render", "none", "--n-episodes", "5")
    assert "return 1 (sampled, 5 episodes)" in type_in_own_folder("enjoy.py", path, *words)[1]
    agent, env = load_algorithm("qlearning").load(path), gym.make("GridWorld-v0").unwrapped
    for places in itertools.permutations(map(np.array, np.ndindex(5, 5)), 2):
        env.agent, env.target = places
        walk = (env.step(agent.predict(env.seen(), deterministic=True)[0]) for _ in range(1000))
        assert any(terminated for _, _, terminated, *_ in walk)


def test_a_model_that_is_not_used_is_told(train):
    code, out, err = train("Known")
    assert (code, err) == (0, ""), err
    assert "has P, but not initial_state_distrib" in " ".join(out.split())


def test_a_process_that_is_left_early_has_not_succeeded(train, own_folder):
    words = ["--algo", "qlearning", "--env", "Leaves-v0", "-n", "200", "--gym-packages", "strange"]
    done = subprocess.run([sys.executable, ROOT / "train.py", *words], cwd=own_folder, check=False)
    assert done.returncode == 1


def test_an_exception_without_words_ends_the_run(train, own_folder):
    (own_folder / "now").touch()
    code, _, err = train("Rude")
    assert code == 1
    assert "RudeError" in err


def test_a_map_from_another_editor(type_in_own_folder, own_folder):
    (own_folder / "lake.txt").write_bytes(b"SF  \r\nFG\r\n")
    words = ("--algo", "qlearning", "--env", "FrozenLake-v1", "--env-kwargs", "desc:lake.txt")
    code, out, err = type_in_own_folder("train.py", *words, "is_slippery:False", *SHORT)
    assert (code, err) == (0, ""), err
    assert "return 1 of 1 " in out


def test_a_log_with_the_index_of_pandas(type_in_own_folder, own_folder):
    rows = [f"{i},{i % 2},{i % 2},0.5" for i in range(200)]
    (own_folder / "log.csv").write_text("\n".join([",arm,reward,propensity", *rows]) + "\n")
    words = ("--env", "ReplayBandit-v0", "--algo", "ucb", "--env-kwargs", "log:log.csv", *SHORT)
    with pytest.warns(UserWarning, match="first column, which counts the rows, is left out"):
        code, _, err = type_in_own_folder("train.py", *words)
    assert (code, err) == (0, "")


def test_results_go_into_what_is_no_file(type_in_own_folder, own_folder):
    pipe = own_folder / "pipe"
    os.mkfifo(pipe)
    reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    words = ("shaping", "--env", "FrozenLake-v1", "-params", "gamma:0.9", "--json", "pipe")
    code, _, err = type_in_own_folder("yardstick", *words)
    assert (code, err) == (0, ""), err
    assert json.loads(os.read(reading, 1 << 20))
    assert pipe.is_fifo()
    os.close(reading)


def test_a_study_of_another_program_is_never_written(type_in_own_folder, own_folder):
    folder = own_folder / "logs" / "tuning" / "mine"
    folder.mkdir(parents=True)
    path = folder / "trials.log"
    storage = JournalStorage(JournalFileBackend(str(path)))
    study = optuna.create_study(study_name="mine", storage=storage)
    study.optimize(lambda trial: trial.suggest_float("x", 0, 1), n_trials=1)
    before = path.read_bytes()
    search = ("tune.py", "--algo", "qlearning", "--env", "FrozenLake-v1", "--name", "mine")
    code, _, err = type_in_own_folder(*search)
    assert (code, err.count("\n")) == (2, 1)
    assert "holds the Optuna study mine of another program" in err
    assert path.read_bytes() == before


OWN = """
from rl_yardstick import agents
from rl_yardstick.agents.tabular.q_learning_and_sarsa import QLearning

agents.register("mine", "own_agents:Mine", observations=["Discrete"])

class Mine(QLearning):
    pass
"""


def test_runs_of_other_code_are_not_taken(type_in_own_folder, own_folder, in_this_process):
    words = ("--gym-packages", "own_agents", "--env", "FrozenLake-v1", "--algos", "mine")
    words += ("-n", "50", "--seeds", "1", "--no-report")
    answers = []
    for code in (OWN, OWN, OWN.replace("pass", "trait = 1")):
        (own_folder / "own_agents.py").write_text(code)
        answers.append(type_in_own_folder("compare.py", *words))
        del sys.modules["own_agents"], ALGORITHMS["mine"]
    assert [code for code, *_ in answers] == [0, 0, 2]
    assert "1 runs, 1 of them there already" in answers[1][1]
    assert "1 finished run has other settings (code: " in answers[2][2]
    resuming = ("compare.py", "--resume", "logs/studies/FrozenLake-v1_mine", *words[:2])
    assert "was begun with other code of own_agents" in type_in_own_folder(*resuming)[2]

"""What people bring works, or one line says why: a command for each case, as a user types it."""

import itertools
import json
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


@pytest.fixture(autouse=True)
def strange(own_folder):
    (own_folder / "strange.py").write_bytes((HERE / "strange_environments.py").read_bytes())


def training(env, *words, algo="qlearning"):
    """The command that trains on one of the strange environments."""
    choice = ("--gym-packages", "strange", "--env", f"{env}-v0", "--algo", algo)
    return ("train.py", *choice, *SHORT, *words)


@pytest.mark.parametrize(("env", "algo", "said"), STRANGE["refused"])
def test_what_nothing_can_learn_on_is_refused(typed, own_folder, env, algo, said):
    assert said in typed.refused(*training(env, algo=algo))
    assert not (own_folder / "logs").exists()


@pytest.mark.filterwarnings("ignore:.*WARN.*:UserWarning")  # Gymnasium's own
@pytest.mark.parametrize(("env", "algo", "said"), STRANGE["noted"])
def test_what_is_odd_is_said_once(typed, own_folder, env, algo, said):
    words = ["-params", "n_steps:64"] if algo == "ppo" else []
    assert typed.done(*training(env, *words, algo=algo)).count(said) == 1
    (record,) = own_folder.glob("logs/*/*/run.json")
    assert said in json.loads(record.read_text())["notes"][0]


def test_a_wrapper_of_ours_fits_and_is_named_to_be_typed(typed):
    err = typed.refused(*training("Vector"))
    assert BINS in err
    out = typed.done(*training("Vector", *shlex.split(err.partition("add ")[2])))
    assert "return -4 " in out
    assert "note:" not in out


@pytest.mark.parametrize(("env", "said"), STRANGE["numbered"])
def test_finite_spaces_are_numbered(typed, env, said):
    out = typed.done(*training(env))
    assert out.count(f"observations: {said}") == 1
    assert "return -4 " in out


def test_the_grid_world_of_gymnasium_is_solved(typed, own_folder):
    """Its zip plays in plain Stable-Baselines3, from every start to every target."""
    out = typed.done(*training("GridWorld", "-n", "20000"))
    assert "observations: Dict(agent: Box(2), target: Box(2)) as 625 rows" in out
    (path,) = own_folder.glob("logs/qlearning/*/GridWorld-v0.zip")
    words = ("--gym-packages", "strange", "--render", "none", "--n-episodes", "5")
    assert "return 1 (sampled, 5 episodes)" in typed.done("enjoy.py", path, *words)
    agent, env = load_algorithm("qlearning").load(path), gym.make("GridWorld-v0").unwrapped
    for places in itertools.permutations(map(np.array, np.ndindex(5, 5)), 2):
        env.agent, env.target = places
        walk = (env.step(agent.predict(env.seen(), deterministic=True)[0]) for _ in range(1000))
        assert any(terminated for _, _, terminated, *_ in walk)


def test_a_table_without_starts_is_searched_for(typed):
    assert "return -4 of -4" in typed.done(*training("Known"))


def test_a_process_that_is_left_early_has_not_succeeded(own_folder):
    script, *words = training("Leaves", "-n", "200")
    done = subprocess.run([sys.executable, ROOT / script, *words], cwd=own_folder, check=False)
    assert done.returncode == 1


def test_an_exception_without_words_ends_the_run(typed, own_folder):
    (own_folder / "now").touch()
    code, _, err = typed(*training("Rude"))
    assert code == 2
    where = "qlearning on Rude-v0, seed 0, at step 0"
    assert err.endswith(f"{where}: RudeError: RudeError\n")


def test_a_map_from_another_editor(typed, own_folder):
    (own_folder / "lake.txt").write_bytes(b"SF  \r\nFG\r\n")
    words = ("--algo", "qlearning", "--env", "FrozenLake-v1", "--env-kwargs", "desc:lake.txt")
    assert "return 1 of 1 " in typed.done("train.py", *words, "is_slippery:False", *SHORT)


def test_a_log_with_the_index_of_pandas(typed, own_folder):
    rows = [f"{i},{i % 2},{i % 2},0.5" for i in range(200)]
    (own_folder / "log.csv").write_text("\n".join([",arm,reward,propensity", *rows]) + "\n")
    words = ("--env", "ReplayBandit-v0", "--algo", "ucb", "--env-kwargs", "log:log.csv", *SHORT)
    with pytest.warns(UserWarning, match="first column, which counts the rows, is left out"):
        typed.done("train.py", *words)


def test_a_study_of_another_program_is_never_written(typed, own_folder):
    folder = own_folder / "logs" / "tuning" / "mine"
    folder.mkdir(parents=True)
    path = folder / "trials.log"
    storage = JournalStorage(JournalFileBackend(str(path)))
    study = optuna.create_study(study_name="mine", storage=storage)
    study.optimize(lambda trial: trial.suggest_float("x", 0, 1), n_trials=1)
    before = path.read_bytes()
    search = ("tune.py", "--algo", "qlearning", "--env", "FrozenLake-v1", "--name", "mine")
    assert "holds the Optuna study mine of another program" in typed.refused(*search)
    assert path.read_bytes() == before


OWN = """
from rl_yardstick import agents
from rl_yardstick.agents.tabular.q_learning_and_sarsa import QLearning

agents.register("mine", "own_agents:Mine", observations=["Discrete"])

class Mine(QLearning):
    pass
"""


def test_runs_of_other_code_are_not_taken(typed, own_folder, in_this_process):
    words = ("--gym-packages", "own_agents", "--env", "FrozenLake-v1", "--algos", "mine")
    words += ("-n", "50", "--seeds", "1", "--no-report")
    answers = []
    for code in (OWN, OWN, OWN.replace("pass", "trait = 1")):
        (own_folder / "own_agents.py").write_text(code)
        answers.append(typed("compare.py", *words))
        del sys.modules["own_agents"], ALGORITHMS["mine"]
    assert [code for code, *_ in answers] == [0, 0, 2]
    assert "1 runs, 1 of them there already" in answers[1][1]
    assert "1 finished run has other settings (code: " in answers[2][2]
    resuming = ("compare.py", "--resume", "logs/studies/FrozenLake-v1_mine", *words[:2])
    assert "was begun with other code of own_agents" in typed(*resuming)[2]

"""train.py, enjoy.py and compare.py on agents and environments of a user's own."""

import json
import shlex
import subprocess
import sys

import gymnasium
import pytest

import compare
from agents import ALGORITHMS

AGENTS = '''
"""An agent as a stranger writes it, and an environment."""

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

import agents

agents.register("lazy", f"{__name__}:Lazy", summary="counts [rewards]", actions=("Discrete",))
gymnasium.register("my/Lake-v0", "gymnasium.envs.toy_text:FrozenLakeEnv", max_episode_steps=30)


class LazyPolicy(BasePolicy):
    def __init__(self, observation_space, action_space, lr_schedule=None):
        super().__init__(observation_space, action_space)
        self.register_buffer("counts", torch.zeros(int(action_space.n)))

    def _predict(self, observation, deterministic=False):
        return torch.full((len(observation),), int(self.counts.argmax()))


class Lazy(BaseAlgorithm):
    policy_aliases = {"LazyPolicy": LazyPolicy}

    def __init__(self, policy, env, weight=0.5, _init_setup_model=True):
        super().__init__(policy, env, learning_rate=0.1, support_multi_env=True)
        self.weight = weight
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self):
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self.policy_class(self.observation_space, self.action_space)

    def learn(self, total_timesteps, callback=None, log_interval=1, tb_log_name="run",
              reset_num_timesteps=True, progress_bar=False):
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total_timesteps:
            actions = np.array([self.action_space.sample() for _ in range(self.n_envs)])
            _, _, dones, infos = self.env.step(actions)
            self.policy.counts[actions] += self.weight
            self.num_timesteps += self.n_envs
            callback.update_locals(locals())
            if not callback.on_step():
                break
        callback.on_training_end()
        return self
'''
LAZY = ["--algo", "lazy", "--env", "my/Lake-v0"]
PLAY = ["--n-episodes", "1", "--render", "none"]


@pytest.fixture
def in_own_folder(own_folder, type_in_own_folder):
    (own_folder / "my_agents.py").write_text(AGENTS)
    return type_in_own_folder


@pytest.mark.parametrize("typed", ["my_agents", "./my_agents.py", "my_package"])
def test_an_agent_of_ones_own_is_trained_and_played(in_own_folder, own_folder, typed, tmp_path):
    if typed == "my_package":
        (own_folder / "my_package").mkdir()
        (own_folder / "my_agents.py").rename(own_folder / "my_package" / "__init__.py")
    own = ["--gym-packages", typed]
    code, out, err = in_own_folder("train.py", *LAZY, *own, "-n", "60", "-params", "weight:1e-2")
    assert (code, err) == (0, "")
    words = " ".join(out.split())
    assert f"python enjoy.py --algo lazy --env my/Lake-v0 --gym-packages {typed}" in words
    run = own_folder / "logs" / "lazy" / "my-Lake-v0_1"
    spec = json.loads((run / "run.json").read_text())["spec"]
    assert spec["hyperparams"]["weight"] == 0.01
    assert spec["user_modules"][0]["typed"] == typed
    code, out, err = in_own_folder("enjoy.py", *LAZY, *own, *PLAY)
    assert (code, err) == (0, "")
    assert "(exact)" in out


def test_a_run_does_not_have_modules_imported(in_own_folder, own_folder, monkeypatch, tmp_path):
    """It says what to type instead, from wherever it is asked."""
    assert in_own_folder("train.py", *LAZY, "--gym-packages", "my_agents", "-n", "40")[0] == 0
    del ALGORITHMS["lazy"], sys.modules["my_agents"], gymnasium.registry["my/Lake-v0"]
    logs = own_folder / "logs"
    run = logs / "lazy" / "my-Lake-v0_1"
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    by_name, by_path = [*LAZY, "-f", logs], [run / "my-Lake-v0.zip", "-f", logs]
    for words in (by_name, by_path):
        code, _, err = in_own_folder("enjoy.py", *words, *PLAY)
        assert code == 2
        assert "no module is imported because a file asks: add --gym-packages " in err
        assert shlex.split(err)[-1] == str(own_folder / "my_agents.py")
        assert "my_agents" not in sys.modules
    (own_folder / "my_agents.py").rename(own_folder / "gone.py")
    copy = shlex.split(in_own_folder("enjoy.py", *by_path, *PLAY)[2])[-1]
    assert copy == str(run / "modules" / "my_agents.py")
    code, _, err = in_own_folder("enjoy.py", *by_path, *PLAY, "--gym-packages", copy)
    assert (code, err) == (0, "")


def test_an_agent_of_ones_own_is_listed_and_guessed(in_own_folder):
    code, out, _ = in_own_folder("train.py", "--list", "--gym-packages", "my_agents")
    assert code == 0
    assert any(line.split()[:3] == ["lazy", "counts", "[rewards]"] for line in out.splitlines())
    words = ["train.py", "--gym-packages", "my_agents", "--env", "my/Lake-v0"]
    code, _, err = in_own_folder(*words, "--algo", "lasy", "-n", "9")
    assert (code, "did you mean 'lazy'?" in err) == (2, True)
    code, _, err = in_own_folder(*words, "--algo", "lazy")
    assert (code, "how long to train? give -n STEPS" in err) == (2, True)


def test_ids_make_the_same_folders(in_own_folder, own_folder):
    """With and without the module, alone and in a study."""
    env = ["--env", "my_agents:my/Lake-v0"]
    assert in_own_folder("train.py", *env, "--algo", "random", "-n", "30")[0] == 0
    assert in_own_folder("enjoy.py", *env, "--algo", "random", *PLAY)[0] == 0
    words = ["compare.py", *env, "--algos", "random", "-n", "30", "--seeds", "1", "--no-report"]
    code, _, err = in_own_folder(*words)
    assert (code, err) == (0, "")
    assert (own_folder / "logs" / "random" / "my-Lake-v0_1").is_dir()
    assert (own_folder / "logs/studies/my-Lake-v0_random/runs/random/my-Lake-v0_1").is_dir()


def test_a_study_file_imports_nothing(in_own_folder, own_folder):
    study = own_folder / "study.yml"
    study.write_text("agents: [random]\nenvironments: ['my_agents:my/Lake-v0']\nn_timesteps: 9\n")
    code, _, err = in_own_folder("compare.py", study)
    assert code == 2
    assert err.endswith("study.yml:2: 'my_agents:my/Lake-v0': its module is not imported because a "
                        "file asks: add --gym-packages my_agents\n")  # fmt: skip
    assert "my_agents" not in sys.modules


def test_a_study_in_a_folder_full_of_names(own_folder):
    """A new process, typed in a folder with modules that have the names of ours and Python's."""
    (own_folder / "my_agents.py").write_text(AGENTS)
    for name in ("agents", "envs", "json", "numpy", "experiments", "pipeline", "mdp", "typing"):
        (own_folder / f"{name}.py").write_text("raise SystemExit('a module of the user was taken')")
    (own_folder / "lazy.yml").write_text("my/Lake-v0:\n  n_timesteps: 40\n  weight: 0.25\n")
    words = [sys.executable, compare.__file__, "--gym-packages", "./my_agents.py"]
    words += ["--env", "my/Lake-v0", "--algos", "lazy", "random", "--seeds", "2", "--no-report"]
    words += ["--conf-file", "lazy:lazy.yml", "-n", "50"]
    done = subprocess.run(words, cwd=own_folder, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    runs = sorted(own_folder.glob("logs/studies/*/runs/lazy/*/run.json"))
    specs = [json.loads(run.read_text())["spec"] for run in runs]
    assert [spec["hyperparams"] for spec in specs] == [{"n_timesteps": 50, "weight": 0.25}] * 2

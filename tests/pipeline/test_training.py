"""Trainings: what an outcome tells, when evaluations come, what ends a training, and pictures."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation import sampled
from rl_yardstick.pipeline.run import Run
from rl_yardstick.pipeline.training import train
from tests.pipeline.short_runs import CART, LAKE, run_of, spec_of, trained

SMALL_PPO = {"n_steps": 32, "batch_size": 16, "n_epochs": 1, "n_envs": 1}


@pytest.fixture(autouse=True)
def own_place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sampled, "STEPS_IN_ANY_CASE", 200)


@pytest.mark.parametrize(
    ("algo", "entry", "fields", "steps"),
    [
        ("qlearning", {}, {"eval_freq": 250}, [250, 500, 750, 1000]),
        ("qlearning", {"n_envs": 4}, {"eval_freq": 250}, [248, 496, 744, 992]),
        ("qlearning", {}, {"eval_freq": 700}, [700]),
        ("qlearning", {}, {}, list(range(50, 1001, 50))),
        ("qlearning", {}, {"eval_freq": 5000}, [1000]),  # at the end, if at no other time
        ("qlearning", {}, {"eval_freq": -1}, None),
        ("qlearning", {"engine": "interpreted"}, {"eval_freq": 300}, [300, 600, 900]),
    ],
)
def test_when_evaluations_come(algo, entry, fields, steps):
    run, outcome = trained(algo, LAKE, entry, n_timesteps=1000, **fields)
    path = run.path / "evaluations.npz"
    assert (steps is None) == (outcome.final is None) == (not path.exists())
    if steps is not None:
        assert np.load(path)["timesteps"].tolist() == steps
        assert outcome.evaluation.best_timesteps in steps


def test_an_outcome_tells_what_the_run_folder_has():
    run, outcome = trained("qlearning", LAKE, n_timesteps=2000)
    record = run.recorded()
    figures = outcome.figures()
    assert {key: record[key] for key in figures} == figures
    assert outcome.final.is_exact
    assert figures["final"]["gap"] == pytest.approx(
        figures["final"]["optimum"] - figures["final"]["mean_return"]
    )
    assert (outcome.agent.num_timesteps, outcome.engine, outcome.pulled) == (2000, "compiled", None)
    assert outcome.progress.taken.cpu_seconds > 0
    assert record["versions"]["python"].startswith("3.")


def test_a_budget_of_episodes_ends_after_so_many():
    run, outcome = trained("sarsa", LAKE, {"n_episodes": 25}, eval_freq=-1)
    rows = (run.path / "0.monitor.csv").read_text().splitlines()
    assert len(rows) == 2 + 25
    assert outcome.agent.num_timesteps == sum(int(row.split(",")[1]) for row in rows[2:])
    with pytest.raises(UserError, match="the schedules of ppo run by steps"):
        trained("ppo", CART, {**SMALL_PPO, "n_episodes": 3, "learning_rate": "lin_0.001"})


def test_a_bandits_pulls_are_summed_up():
    run, outcome = trained("ucb", "BernoulliBandit-v0", n_timesteps=300)
    pulls = np.load(run.path / "pulls.npz")
    assert outcome.pulled.n_pulls == 300 == pulls["regrets"].size
    assert outcome.pulled.regret == pytest.approx(float(pulls["regrets"].sum()))
    assert run.recorded()["regret"] == outcome.pulled.regret
    assert outcome.final is None or outcome.final.mean_return is not None


# --- numbers that are not finite, and errors ------------------------------------------------------


class Sick(gym.Env):
    """Returns a wrong number, or raises an error, at its 30th step."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)
    fault = None

    def __init__(self, fault="reward"):
        self.fault, self.n_steps = fault, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.n_steps += 1
        is_time = self.n_steps == 30
        if is_time and self.fault == "error":
            raise RuntimeError("the motor is broken")
        if is_time and self.fault == "exit":
            raise SystemExit("enough")
        obs = np.full(2, np.nan if is_time and self.fault == "observation" else 0, np.float32)
        reward = float("inf") if is_time and self.fault == "reward" else 1.0
        return obs, reward, self.n_steps % 10 == 0, False, {}


@pytest.mark.parametrize(
    ("fault", "kind", "said"),
    [
        ("reward", UserError, "reward of environment 0 at step 30 is inf"),
        (
            "observation",
            UserError,
            "last observation of an episode of environment 0 at step 30 is nan",
        ),
        ("error", RuntimeError, "the motor is broken"),  # of the user's own code, as it is
        ("exit", SystemExit, "enough"),
    ],
)
def test_what_an_environment_does_wrong(fault, kind, said, monkeypatch):
    monkeypatch.setattr(gym.envs.registration, "registry", dict(gym.registry))
    monkeypatch.setattr(gym, "registry", gym.envs.registration.registry)
    gym.register("Sick-v0", Sick, max_episode_steps=50, kwargs={"fault": fault})
    spec = spec_of("ppo", "Sick-v0", SMALL_PPO, n_timesteps=64, eval_freq=16, eval_episodes=1)
    run = Run.claim(Path("logs"), spec)
    run.begin(spec, {}, "train.py")
    with pytest.raises(kind, match=said), run:
        train(spec, run)
    record = run.recorded()
    assert record["state"] == "failed"
    assert said.split()[-1] in record["reason"]
    assert not (run.path / "Sick-v0.zip").exists()


def test_an_agent_that_learns_nonsense_is_not_saved():
    entry = {**SMALL_PPO, "learning_rate": 1e30, "max_grad_norm": 1e30}
    with pytest.raises(UserError, match=r"is (nan|inf|-inf)"):
        trained("ppo", CART, entry, n_timesteps=128, eval_freq=-1)
    assert not list(Path("logs").rglob("CartPole-v1.zip"))


@pytest.mark.parametrize(
    ("algo", "entry", "said"),
    [
        ("ppo", {"policy": "CnnPolicy"}, "CnnPolicy"),
        ("ppo", {"policy": "MlpPolcy"}, "unknown policy 'MlpPolcy': did you mean 'MlpPolicy'"),
        ("ppo", {"policy_kwargs": {"net_arhc": [4]}}, "net_arhc"),
        ("ppo", {"rollout_buffer_class": "HerReplayBuffer"}, "HerReplayBuffer"),
        ("dqn", {"train_freq": [1, "day"]}, "day"),
    ],
)
def test_what_only_the_constructor_knows_is_one_line_and_leaves_no_folder(algo, entry, said):
    with pytest.raises(UserError) as caught:
        trained(algo, CART, entry, n_timesteps=64)
    assert said in str(caught.value)
    assert not Path("logs").exists()


# --- what is printed and drawn --------------------------------------------------------------------


def test_pictures():
    spec = spec_of("qlearning", LAKE, n_timesteps=2000, diagnose=True)
    run, outcome = run_of(spec.changed(pictures=True))
    assert outcome.can_be_explained
    for name in ("learning_curve.png", "value_map.png", "diagnosis.png"):
        assert (run.path / name).stat().st_size > 5000


def test_subprocesses_do_the_same():
    common = {"n_timesteps": 128, "eval_freq": 64, "eval_episodes": 1, "final_episodes": 1}
    entry = {**SMALL_PPO, "n_envs": 2}
    here, _ = trained("ppo", CART, entry, **common)
    there, _ = trained("ppo", CART, entry, vec_env="subproc", **common)
    one, other = (np.load(run.path / "evaluations.npz")["results"] for run in (here, there))
    np.testing.assert_array_equal(one, other)

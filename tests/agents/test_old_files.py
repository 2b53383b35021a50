"""Files that the first version saved load, play and go on learning as they did then.

`first_version/` holds a zip of each agent, made by that version; `answers.json` what it did with
them: the actions of its deterministic policy, and the tables after 200 further steps.
"""

import importlib
import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the bandits
from agents import ALGORITHMS, load_algorithm
from agents.old_names import MOVED

FILES = Path(__file__).parent / "first_version"
ANSWERS = json.loads((FILES / "answers.json").read_text())
POLES = np.array([[0, 0, 0.1, 0], [0, 0, -0.1, 0]], dtype=np.float32)


def environment_id(name):
    if name in ("angle", "ppo"):
        return "CartPole-v1"
    return "SegmentBandit-v0" if ALGORITHMS[name].for_bandits else "FrozenLake-v1"


@pytest.mark.parametrize("name", [name for name in ANSWERS if "/" not in name])
def test_actions_are_the_same(name):
    env = gym.make(environment_id(name))
    space = env.observation_space
    obs = np.arange(space.n) if isinstance(space, gym.spaces.Discrete) else POLES
    model = load_algorithm(name).load(FILES / f"{name}.zip")
    assert model.predict(obs, deterministic=True)[0].tolist() == ANSWERS[name]
    env.close()


@pytest.mark.parametrize(
    "name", [name.removesuffix("/continued") for name in ANSWERS if "/" in name]
)
def test_training_goes_on_to_the_same_bits(name):
    env = make_vec_env(environment_id(name), seed=5)
    model = load_algorithm(name).load(FILES / f"{name}.zip", env=env)
    model.learn(200, reset_num_timesteps=False)
    expected = ANSWERS[f"{name}/continued"]
    if isinstance(expected, int):
        assert model.num_timesteps == expected
        return
    tables = model.policy.state_dict()
    assert [tables[key].tolist() for key in sorted(tables)] == expected


def test_a_schedule_of_ours_in_a_zip_of_the_library():
    """The library's zips name the schedule's class by the module that it lived in."""
    model = PPO.load(FILES / "ppo.zip", device="cpu")
    assert model.lr_schedule(0.5) == pytest.approx(1e-3 * 0.1**0.5)
    double = DQN.load(FILES / "double_dqn.zip", env=make_vec_env("FrozenLake-v1"), device="cpu")
    assert double.lr_schedule(1.0) == pytest.approx(1e-3)


@pytest.mark.parametrize("old", MOVED)
def test_every_old_name_leads_to_modules_that_are_there(old):
    module = importlib.import_module(old)
    for home in MOVED[old]:
        for name, value in vars(importlib.import_module(home)).items():
            if getattr(value, "__module__", None) == home:
                assert getattr(module, name) is value
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        getattr(module, "nonsense")  # noqa: B009  # looking it up is the test

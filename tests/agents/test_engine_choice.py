"""When a training runs compiled, and what is said when it does not."""

from functools import partial

import gymnasium as gym
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from agents import load_algorithm
from envs.wrappers import DiscretizeObservation, TerminationReward


class Foreign(gym.Wrapper):
    """Nobody knows what it does."""


class Blank(gym.Env):
    """One state, without a model."""

    observation_space = spaces.Discrete(1)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, 1.0, bool(self.np_random.random() < 0.1), False, {}


class Curious(BaseCallback):
    def _on_step(self):
        return True


def lake(**kwargs):
    return make_vec_env("FrozenLake-v1", 1, seed=0, **kwargs)


def pole(wrapper=lambda env: env, **kwargs):
    env = gym.make("CartPole-v1", **kwargs)
    return DiscretizeObservation(wrapper(env), bins=4, low=-1, high=1)


def changed(env, **attributes):
    """The environment after some of its attributes have been set by hand."""
    vars(env.unwrapped).update(attributes)
    return env


UNSUITED = {
    "SubprocVecEnv is not DummyVecEnv": lambda: lake(vec_env_cls=SubprocVecEnv),
    "VecNormalize is not DummyVecEnv": lambda: VecNormalize(lake(), norm_obs=False),
    "the environment's transition model is not known": lambda: lake(wrapper_class=Foreign),
    "transition model is not known": Blank,
    "the environments are not alike": lambda: DummyVecEnv(
        [lambda: gym.make("FrozenLake-v1"), lambda: gym.make("FrozenLake-v1", is_slippery=False)]
    ),
    "environments are not alike": lambda: DummyVecEnv([pole, lambda: changed(pole(), gravity=1.6)]),
    "are not alike": lambda: DummyVecEnv(
        [lambda: gym.make("FrozenLake-v1"), lambda: Monitor(gym.make("FrozenLake-v1"))]
    ),
    "Monitor records further keys": lambda: lake(monitor_kwargs={"info_keywords": ("prob",)}),
    "a time limit lies outside Monitor": lambda: lake(
        wrapper_class=partial(gym.wrappers.TimeLimit, max_episode_steps=9)
    ),
    "model is not known": lambda: lake(
        wrapper_class=partial(TerminationReward, reward=0.0, on_truncation=True)
    ),
    "more than one Monitor": lambda: lake(wrapper_class=Monitor),
    "RecordEpisodeStatistics must see every step": lambda: lake(
        wrapper_class=gym.wrappers.RecordEpisodeStatistics
    ),
    "RecordEpisodeStatistics, RenderCollection must see every step": lambda: lake(
        env_kwargs={"render_mode": "ansi"},
        wrapper_class=lambda env: gym.wrappers.RenderCollection(
            gym.wrappers.RecordEpisodeStatistics(env)
        ),
    ),
    "the environment is shown on the screen": lambda: lake(env_kwargs={"render_mode": "human"}),
    "under DiscretizeObservation and Monitor alone": lambda: pole(gym.wrappers.Autoreset),
    "with its default reward alone": lambda: pole(sutton_barto_reward=True),
}


@pytest.mark.parametrize(("reason", "make_env"), UNSUITED.items(), ids=UNSUITED)
def test_environments_without_compiled_counterpart(reason, make_env):
    env = make_env()
    model = load_algorithm("qlearning")(env=env, engine="compiled", seed=0)
    with pytest.raises(ValueError, match=f"engine: compiled is not possible: .*{reason}"):
        model.learn(2)
    model.engine = "auto"
    model.learn(2)
    assert model.engine_in_use.startswith("interpreted: ")
    assert reason in model.engine_in_use
    env.close()


@pytest.mark.parametrize(
    ("kwargs", "callback", "reason"),
    [
        ({"learning_rate": lambda progress: 0.1 * progress}, None, "schedule is a Python function"),
        (
            {"exploration": "boltzmann", "temperature": lambda progress: 1 + progress},
            None,
            "schedule is a Python function",
        ),
        ({}, Curious(), "Curious must be asked after each step"),
        ({}, lambda local, _: True, "ConvertCallback must be asked after each step"),
        ({}, [Curious(), StopTrainingOnMaxEpisodes(5)], "Curious must be asked after each step"),
    ],
)
def test_what_must_be_asked_after_each_step(kwargs, callback, reason):
    model = load_algorithm("qlearning")(env="FrozenLake-v1", engine="compiled", seed=0, **kwargs)
    with pytest.raises(ValueError, match=f"engine: compiled is not possible: .*{reason}"):
        model.learn(20, callback=callback)
    model.engine = "auto"
    model.learn(20, callback=callback)
    assert model.engine_in_use.startswith("interpreted: ")
    assert reason in model.engine_in_use


def test_an_agent_that_learns_in_its_own_way():
    class Unteachable(load_algorithm("qlearning")):
        def _learn_from(self, transitions):
            pass

    model = Unteachable(env="FrozenLake-v1", seed=0).learn(100)
    assert model.engine_in_use == "interpreted: Unteachable has a _learn_from of its own in Python"
    assert int(model.policy.visit_counts.sum()) == 0


@pytest.mark.parametrize("engine", ["interpreted", "compiled"])
def test_a_training_of_no_steps(engine):
    model = load_algorithm("sarsa")(env="FrozenLake-v1", engine=engine, seed=0).learn(0)
    assert (model.num_timesteps, model._current_progress_remaining) == (0, 1.0)
    model.learn(99)
    states = []
    for _ in range(2):
        generator = model.env.envs[0].unwrapped.np_random
        pending = model._last_obs.tolist(), model._next_actions.tolist()
        states.append((pending, model.num_timesteps, generator.bit_generator.state))
        model.learn(0, reset_num_timesteps=False)
    assert states[0] == states[1]


def test_the_engine_that_was_asked_for():
    model = load_algorithm("qlearning")(env="FrozenLake-v1")
    in_use = []
    for engine in ("interpreted", "auto", "compiled"):
        model.engine = engine
        in_use.append(model.learn(10).engine_in_use)
    assert in_use == ["interpreted: asked for", "compiled", "compiled"]

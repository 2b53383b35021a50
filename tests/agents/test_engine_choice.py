"""When a training of a table runs compiled, and what is said when it does not."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import rl_yardstick.envs  # noqa: F401  # registers the environments
from rl_yardstick.agents import load_algorithm
from rl_yardstick.envs import checking as model_checks
from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.envs.wrappers import DiscretizeObservation
from tests.envs.corridors import Backwards, Corridor, Deaf, outcomes


class Foreign(gym.Wrapper):
    """Nobody knows what it does."""


class Curious(BaseCallback):
    """Has to be asked after each step."""

    seen = 0

    def _on_step(self):
        self.seen += 1
        return True


def lake(**kwargs):
    return make_vec_env("FrozenLake-v1", 1, seed=0, **kwargs)


def pole(wrapper=lambda env: env, **kwargs):
    return DiscretizeObservation(wrapper(gym.make("CartPole-v1", **kwargs)), bins=4, low=-1, high=1)


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    """Checks of a model take many steps, and are kept."""
    monkeypatch.setattr(model_checks, "N_STEPS", 5_000)
    monkeypatch.setattr(model_checks, "_checks", {})


def calm():
    """A corridor that tells of no wind, though it blows."""
    return TimeLimit(Corridor(outcomes(wind=0.0)), 10)


make_lake = partial(gym.make, "FrozenLake-v1")
INTERPRETED = {  # reason: environment, settings, callback
    "VecNormalize is not DummyVecEnv": (lambda: VecNormalize(lake(), norm_obs=False),),
    "the environment's transition model is not known": (partial(lake, wrapper_class=Foreign),),
    "rewards are drawn, and the environment's model": (partial(gym.make, "MaximizationBias-v0"),),
    "the environments are not alike": (
        lambda: DummyVecEnv([make_lake, partial(make_lake, is_slippery=False)]),),
    "the environment is shown on the screen": (partial(lake, env_kwargs={"render_mode": "human"}),),
    "a time limit lies outside Monitor": (
        partial(lake, wrapper_class=partial(TimeLimit, max_episode_steps=9)),),
    "under DiscretizeObservation and Monitor alone": (partial(pole, gym.wrappers.Autoreset),),
    "does not continue from the state": (lambda: TimeLimit(Deaf(), 10),),
    "the environment's P is not what step does: state ": (calm,),
    "schedule is a Python function": (lake, {"learning_rate": lambda progress: 0.1 * progress}),
    "ConvertCallback must be asked after each step": (lake, {}, lambda: lambda local, _: True),
    "Curious must be asked after each step$": (
        lake, {}, lambda: [CallbackList([Curious()]), StopTrainingOnMaxEpisodes(5)]),
}  # fmt: skip


@pytest.mark.parametrize("reason", INTERPRETED)
def test_what_is_interpreted_and_why(reason):
    make_env, *rest = INTERPRETED[reason]
    settings, callback = (*rest, *({}, None)[len(rest) :])
    env, callback = make_env(), callback and callback()
    model = load_algorithm("qlearning")(env=env, engine="compiled", seed=0, **settings)
    with pytest.raises(ValueError, match=f"engine: compiled is not possible: .*{reason}"):
        model.learn(2, callback=callback)
    model.engine = "auto"
    model.learn(2, callback=callback)
    assert model.engine_in_use.startswith("interpreted: ")
    env.close()


def test_the_engine_that_was_asked_for():
    model = load_algorithm("qlearning")(env="FrozenLake-v1")
    in_use = []
    for engine in ("interpreted", "auto", "compiled"):
        model.engine = engine
        in_use.append(model.learn(10).engine_in_use)
    assert in_use == ["interpreted: asked for", "compiled", "compiled"]
    plain = Curious()
    model.learn(1_000, callback=EveryNTimesteps(100, plain))
    assert (model.engine_in_use, plain.seen) == ("compiled", 10)


def played(kind, engine, **settings):
    env = TimeLimit(kind(), 50)
    uniform = {"exploration_initial_eps": 1.0, "exploration_final_eps": 1.0}
    model = load_algorithm("qlearning")(env=env, engine=engine, seed=4, **uniform, **settings)
    return model.learn(8_000)


def test_an_environment_of_ones_own_ends_in_the_same_bits_if_it_draws_as_toy_text_does():
    models = [played(Corridor, engine) for engine in ("interpreted", "auto")]
    assert models[1].engine_in_use == "compiled"
    np.testing.assert_array_equal(*(model.policy.q_table for model in models))
    words = {
        "auto": "interpreted: the environment draws in its own way, so that compiled training is "
        "equal in distribution only (engine: compiled takes that)",
        "compiled": "compiled, not bit for bit: the environment draws in its own way",
    }
    tables, expected = [], transition_model(Backwards()).expected_reward
    for engine, said in words.items():
        model = played(Backwards, engine, gamma=0.0, learning_rate="sample_average")
        assert model.engine_in_use == said
        tables.append(np.asarray(model.policy.q_table))
        # With averages and no discount each value is the mean of the pair's rewards, which are -1
        # but for the goal's 9, with a chance of 0.7: five standard errors.
        n = np.maximum(model.policy.visit_counts.numpy()[0], 1)
        spread = np.where(expected == -1, 0, 10 * np.sqrt(0.7 * 0.3 / n))
        visited = model.policy.visit_counts.numpy()[0] > 50
        assert visited[:4].all()
        assert (np.abs(tables[-1] - expected) <= 5 * spread + 1e-9)[visited].all()
    assert not np.array_equal(*tables)
    with pytest.raises(ValueError, match="whose transition model is known: the environment's P is"):
        load_algorithm("value_iteration")(env=calm()).learn(10)


class Liar(gym.Env):
    """Shows what is not in its space, at the start or after a step."""

    observation_space, action_space = spaces.Discrete(4), spaces.Discrete(2)

    def __init__(self, at_start=0, after_step=0):
        self.at_start, self.after_step = at_start, after_step

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.at_start, {}

    def step(self, action):
        return self.after_step, 1.0, False, False, {}


@pytest.mark.parametrize("name", ["qlearning", "epsilon_greedy"])
def test_an_observation_outside_of_the_space_is_refused(name):
    """Compiled code would read and write beside the table."""
    for outside in (4, 10**9, -1):
        for shown in ((outside, 0), (0, outside)):
            model = load_algorithm(name)(env=Liar(*shown), seed=0)
            with pytest.raises(ValueError, match=rf"{outside} is not in Discrete\(4\)"):
                model.learn(5)


class OwnLearning(load_algorithm("qlearning")):
    def _learn_from(self, transitions):
        pass


def test_what_python_does_instead_is_not_compiled_away():
    model = OwnLearning(env="FrozenLake-v1", seed=0).learn(0)
    reason = "OwnLearning has a _learn_from of its own in Python"
    assert model.engine_in_use == f"interpreted: {reason}"


def test_rules_that_are_not_compiled_are_refused():
    with pytest.raises(TypeError, match=r"Plain.next_value is called by compiled code: put @inl"):

        class Plain(load_algorithm("qlearning")):
            def next_value(agent, env, progress, table):  # noqa: N805
                return 0.0

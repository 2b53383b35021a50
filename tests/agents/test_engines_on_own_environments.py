"""Both engines on environments of one's own: right, wrong, or drawn in their own way."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.toy_text.utils import categorical_sample
from gymnasium.wrappers import TimeLimit

from agents import load_algorithm
from envs import checking as model_checks
from envs.known_models import transition_model


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    monkeypatch.setattr(model_checks, "N_STEPS", 5_000)
    monkeypatch.setattr(model_checks, "_checks", {})


class Wind(gym.Env):
    """Three states in a ring: forwards by action + 1, or not at all; nothing ends it."""

    observation_space = spaces.Discrete(3)
    action_space = spaces.Discrete(2)
    initial_state_distrib = np.array([0.5, 0.5, 0.0])

    def __init__(self):
        self.P = {
            s: {
                a: [(0.7, (s + a + 1) % 3, 1.0 + s, False), (0.3, s, -2.0 * a, False)]
                for a in (0, 1)
            }
            for s in range(3)
        }

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = int(categorical_sample(self.initial_state_distrib, self.np_random))
        return self.s, {}

    def step(self, action):
        row = self.P[self.s][int(action)]
        _, self.s, reward, terminated = row[self.draw(row)]
        return self.s, reward, terminated, False, {}

    def draw(self, row):
        return categorical_sample([outcome[0] for outcome in row], self.np_random)


class OwnWay(Wind):
    """The stillness comes first."""

    def draw(self, row):
        return int(self.np_random.random() < row[1][0])


class Calm(Wind):
    """Steps otherwise than it says."""

    def draw(self, row):
        return 0


class Hidden(Wind):
    """Its place has another name than ``s``."""

    def step(self, action):
        self.s = self.place
        obs, *rest = super().step(action)
        return self._hide(obs), *rest

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed)
        return self._hide(obs), info

    def _hide(self, place):
        self.place = place
        del self.s
        return place


def train(kind, engine, **kwargs):
    model = load_algorithm("qlearning")(
        env=TimeLimit(kind(), 10), engine=engine, seed=4, exploration_final_eps=1.0, **kwargs
    )
    return model.learn(kwargs.pop("steps", 8_000))


def test_an_environment_of_ones_own_ends_in_the_same_bits():
    models = [train(Wind, engine) for engine in ("interpreted", "auto")]
    assert [model.engine_in_use for model in models] == ["interpreted: asked for", "compiled"]
    tables = [model.policy.q_table for model in models]
    np.testing.assert_array_equal(*tables)


def test_one_that_draws_in_its_own_way_is_compiled_where_that_is_asked_for():
    auto = train(OwnWay, "auto")
    assert auto.engine_in_use == (
        "interpreted: the environment draws in its own way, so that compiled training is equal in "
        "distribution only (engine: compiled takes that)"
    )
    np.testing.assert_array_equal(auto.policy.q_table, train(OwnWay, "interpreted").policy.q_table)
    compiled = train(OwnWay, "compiled")
    assert compiled.engine_in_use == (
        "compiled, not bit for bit: the environment draws in its own way"
    )
    assert not np.array_equal(auto.policy.q_table, compiled.policy.q_table)


@pytest.mark.parametrize("engine", ["auto", "compiled"])
def test_one_that_draws_in_its_own_way_is_equal_in_distribution(engine):
    """With averages and no discount each value is the mean of some 1,300 rewards."""
    model = train(OwnWay, engine, gamma=0.0, learning_rate="sample_average")
    expected = transition_model(OwnWay()).expected_reward
    deviation = np.sqrt(0.7 * 0.3) * (1 + np.arange(3)[:, None] + 2 * np.arange(2))
    error = np.asarray(model.policy.q_table) - expected
    # Five standard errors: of six values one is further off in 1 of 300,000 trainings.
    assert (np.abs(error) < 5 * deviation / np.sqrt(1_000)).all()


def test_one_whose_state_cannot_be_set_is_interpreted():
    model = train(Hidden, "auto")
    assert transition_model(Hidden()) is not None
    assert model.engine_in_use == (
        "interpreted: the environment does not go on from where its attribute s is set"
    )


def test_one_that_steps_otherwise_is_interpreted_and_not_planned_for():
    reason = "the environment's P is not what step does: state "
    assert train(Calm, "auto").engine_in_use.startswith(f"interpreted: {reason}")
    with pytest.raises(ValueError, match=f"engine: compiled is not possible: {reason}"):
        train(Calm, "compiled")
    with pytest.raises(ValueError, match=f"whose transition model is known: {reason}"):
        load_algorithm("value_iteration")(env=TimeLimit(Calm(), 10)).learn(10)

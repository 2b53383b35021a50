"""An environment's word on its dynamics is held against what it does."""

import copy
import pickle
import random
import re
import threading

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv

from rl_yardstick.envs import known_models as known
from rl_yardstick.envs.known_models import model_check
from rl_yardstick.envs.warehouse import WarehouseEnv
from rl_yardstick.envs.wrappers import FlattenToDiscrete
from tests.envs.corridors import Backwards, Corridor, Deaf, outcomes


class Careless(Corridor):
    """Draws from the generators that all code shares."""

    def draw(self, row):
        uniform = (random.random() + np.random.random()) % 1  # noqa: NPY002, S311
        return int(uniform < row[1][0])


class Shifted(Corridor):
    """Observes its states as -3 to 1."""

    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Discrete(5, start=-3)

    def observe(self):
        return self.s - 3


SAME_REWARDS = outcomes(goal_reward=-1.0)
# Thirds that do not sum to 1 in single precision.
THIRDS = {
    state: {a: [(np.float32(1) / 3, *rows[a][0][1:])] * 3 for a in rows}
    for state, rows in SAME_REWARDS.items()
}
# Whether it draws bit for bit as toy_text does, and whether its state can be set.
RIGHT = {
    "as toy_text": (Corridor, True, True),
    "other successors": (lambda: Backwards(SAME_REWARDS, SAME_REWARDS), False, True),
    "the global generators": (Careless, False, True),
    "deaf": (Deaf, True, False),
    "thirds": (lambda: Corridor(THIRDS, THIRDS), True, True),
    "from -3": (Shifted, True, True),
}  # fmt: skip


@pytest.mark.parametrize("name", RIGHT)
def test_right_models_are_believed(name):
    make, bit_for_bit, state_can_be_set = RIGHT[name]
    check = model_check(make())
    assert check.refusal is None
    assert (check.bit_for_bit, check.state_can_be_set) == (bit_for_bit, state_can_be_set)


def test_observations_that_do_not_start_at_0():
    for env, first in ((Shifted(), -3), (FlattenToDiscrete(Shifted()), 0)):
        assert known.observations_of_states(env).tolist() == [*range(first, first + 5)]


def odd(kind=Corridor, **other):
    """An environment with other methods and attributes than its class."""
    return type("Odd", (kind,), other)()


def truncates(env, action):
    return *Corridor.step(env, action)[:3], env.steps == 20, {}


def raises(env, action):
    if env.s == 3:
        raise RuntimeError("one\ntwo")
    return Corridor.step(env, action)


def ladder(reward):
    """Each wrong step leads back to the start: 1 in 30,000 random tries comes to the last state."""
    back = [(1.0, 0, 0.0, False)]
    table = {s: {0: back, 1: [(1.0, min(s + 1, 15), 0.0, s == 15)]} for s in range(16)}
    table[15][1] = [(1.0, 15, reward, True)]
    return table


SAYS = r"^the environment's P is not what step does: state 3, action \d: the model has no step to"
FALSE = {
    "reward": (lambda: Corridor(outcomes(goal_reward=10.0), outcomes()),
        rf"{SAYS} the end with the reward 9, the environment made one$"),
    "unknown wind": (lambda: Corridor(outcomes(wind=0.0)),
        rf"{SAYS.replace('3', '.')} . with the reward -1, the environment made one$"),
    "frequency everywhere": (lambda: Careless(outcomes(0.4), outcomes()),
        r"has a probability of 0\.[46], it came \d+ of \d+ times$"),
    "frequency of a start": (
        lambda: Corridor(start=(0.9, 0.1, 0, 0, 0)),
        r"reset: the start in state \d has a probability of 0\.[19], it came"),
    "far away": (lambda: Corridor(ladder(2.0), ladder(1.0), np.eye(16)[0]),
        r"state 15, action 1: the model has no step to the end with the reward 1, "),
    "truncates": (lambda: odd(step=truncates),
        "step, which raised ValueError: it gave truncated: leave time limits to max_episode_steps"),
    "raises": (lambda: odd(step=raises), "against step, which raised RuntimeError: one two$"),
    "pair": (lambda: odd(observe=lambda env: (0, env.s)),
        r"starts in a state \(\(0, 0\)\) that is no start$"),
    "a short outcome": (lambda: Corridor({0: {0: [(1.0,)]}}),
        r"^the environment's P is no model: state 0, action 0: an outcome is \(probab"),
    "by pairs": (lambda: Corridor({(s, 0): [] for s in range(5)}),
        "P must map states, the numbers 0 to 4, to mappings of actions; it begins with"),
    "from 0": (lambda: odd(Shifted, observe=lambda env: env.s),
        r"starts in a state \(0\) that is no start$"),
    "three actions": (lambda: odd(action_space=gym.spaces.Discrete(3)),
        r"P is no model: it has 2 actions, where the space is Discrete\(3\)$"),
}  # fmt: skip


@pytest.mark.parametrize("name", FALSE)
def test_false_models_are_refused_in_one_line(name):
    make, line = FALSE[name]
    check = model_check(make())
    assert re.search(line, check.refusal), check.refusal
    assert "\n" not in check.refusal
    if name == "frequency everywhere":  # its own draws do not depend on what others have drawn
        random.seed(1)
        assert model_check(make()) == check


def test_a_known_class_that_was_changed_is_not_believed_unless_it_does_the_same():
    tellers = known.transition_model, known.success_outcomes, known.observations_of_states
    stays = odd(FrozenLakeEnv, step=lambda env, action: FrozenLakeEnv.step(env, 0))
    by_hand = FrozenLakeEnv()
    by_hand.step = stays.step
    for env in (stays, by_hand):
        assert [teller(env) for teller in tellers] == [None] * 3
    assert "a method was replaced by hand" in known.model_check(by_hand).refusal
    same = odd(FrozenLakeEnv, step=FrozenLakeEnv.step)
    ours, theirs = (known.transition_model(env) for env in (same, FrozenLakeEnv()))
    np.testing.assert_array_equal(ours.prob, theirs.prob)
    assert known.transition_model(odd(WarehouseEnv)) is not None


def test_the_caller_notices_nothing():
    env = gym.wrappers.TimeLimit(Corridor(), 50)
    env.reset(seed=7)
    env.step(1)
    random.seed(3)
    np.random.seed(3)  # noqa: NPY002

    def state():
        shared = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
        attributes = vars(env)["_elapsed_steps"], env.unwrapped.s, env.unwrapped.steps
        generator = env.np_random.bit_generator.state
        return pickle.dumps(env.unwrapped.true), attributes, generator, shared

    before = copy.deepcopy(state())
    assert known.transition_model(env) is not None
    assert state() == before


def test_an_environment_that_cannot_be_copied_is_made_anew():
    assert model_check(gym.make("Locked-v0", true=outcomes(wind=0.5))).refusal is None
    assert "which raised TypeError: cannot pickle" in model_check(Locked()).refusal


class Locked(Corridor):
    """Cannot be copied."""

    def __init__(self, true=None, render_mode=None):
        super().__init__(true=true)
        self.lock = threading.Lock()


gym.register("Locked-v0", entry_point=Locked)


def test_a_model_that_changes_is_checked_anew():
    env = Corridor()
    assert known.transition_model(env) is not None
    env.P = outcomes(wind=0.6)
    assert known.transition_model(env) is None

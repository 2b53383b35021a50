"""An environment's word on its dynamics is held against what it does."""

import copy
import pickle
import random
import re
import threading
from collections import defaultdict

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.envs.toy_text.utils import categorical_sample

import envs
from envs import check_transition_model, checking
from envs.known_models import (
    model_check,
    observations_of_states,
    success_outcomes,
    transition_model,
)
from envs.warehouse import WarehouseEnv

# Where nothing is a question of frequencies, or these are far off.
FEW = 5_000


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    """Where the check is not called by hand it need not find what is rare."""
    monkeypatch.setattr(checking, "N_STEPS", FEW)
    monkeypatch.setattr(checking, "_checks", {})


def outcomes(wind=0.3, goal_reward=9.0, ends=True):
    """A corridor of five states: 0 left, 1 right; wind blows back by two; the goal is 4."""
    table = {}
    for state in range(5):
        table[state] = {}
        for action in (0, 1):
            target = min(max(state + 2 * action - 1, 0), 4)
            goal = target == 4
            moved = (target, goal_reward if goal else -1.0, goal and ends)
            table[state][action] = [(1 - wind, *moved), (wind, max(state - 2, 0), -1.0, False)]
    return table


class Corridor(gym.Env):
    """Steps by ``true``, and tells ``P``; draws as toy_text does."""

    metadata = {"render_modes": ["human"]}  # noqa: RUF012
    action_space = spaces.Discrete(2)

    def __init__(self, told=None, true=None, start=(1, 0, 0, 0, 0), render_mode=None):
        self.true = true or outcomes()
        self.P = told or self.true
        self.initial_state_distrib = np.array(start, float)
        self.observation_space = spaces.Discrete(len(self.P))
        self.render_mode = render_mode
        self.s = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = self.first()
        self.steps = 0
        return self.observe(), {}

    def step(self, action):
        if self.render_mode == "human":
            self.render()
        row = self.true[int(self.s)][action]
        _, self.s, reward, terminated = row[self.draw(row)]
        self.steps += 1
        return self.observe(), reward, terminated, False, {}

    def first(self):
        return int(categorical_sample([1.0, 0.0, 0.0, 0.0, 0.0], self.np_random))

    def draw(self, row):
        return categorical_sample([outcome[0] for outcome in row], self.np_random)

    def observe(self):
        return self.s

    def render(self):
        raise AssertionError("a check draws nothing")


def test_a_right_model_that_draws_as_toy_text_does():
    check = check_transition_model(Corridor())
    assert check.refusal is None
    assert check.bit_for_bit
    assert check.state_can_be_set
    assert check.n_steps >= 55_000


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("FrozenLake-v1", {"map_name": "8x8", "success_rate": 0.6}),
        ("CliffWalking-v1", {"is_slippery": True}),
        ("Taxi-v4", {"is_rainy": True}),
        ("Warehouse-v0", {"slip": 0.2, "random_start": True, "observation": "position"}),
        ("MineMaze-v0", {"slip": 0.4}),
        ("SegmentBandit-v0", {}),
    ],
)
def test_those_whose_word_is_enough_pass(env_id, kwargs):
    check = check_transition_model(gym.make(env_id, **kwargs), n_steps=FEW)
    assert check.refusal is None
    assert check.bit_for_bit
    # Contexts of a bandit come from nowhere: nothing shows whether it goes on from one that is set.
    assert check.state_can_be_set is (env_id != "SegmentBandit-v0")


def altered(**changes):
    """P with one outcome of state 3, action 1 changed."""
    table = outcomes()
    prob, state, reward, terminated = table[3][1][0]
    table[3][1][0] = (
        prob,
        changes.get("state", state),
        changes.get("reward", reward),
        changes.get("terminated", terminated),
    )
    return table


WRONG = {
    "reward": (
        altered(reward=10.0),
        "P says state 4 with reward 10.0, terminated or state 1 with reward -1.0",
    ),
    "termination": (
        altered(terminated=False),
        "P says state 4 with reward 9.0 or state 1 with reward -1.0",
    ),
    "successor": (
        altered(state=0),
        "P says state 0 with reward 9.0, terminated or state 1 with reward -1.0",
    ),
}


@pytest.mark.parametrize(("told", "line"), WRONG.values(), ids=WRONG)
def test_what_the_model_rules_out_is_named(told, line):
    check = check_transition_model(Corridor(told))
    assert check.refusal == (
        f"the environment's P is not what step does: state 3, action 1: {line}, "
        "step gave state 4 with reward 9.0, terminated"
    )


def test_wind_that_the_model_does_not_know_is_named():
    assert check_transition_model(Corridor(outcomes(wind=0.0)), FEW).refusal == (
        "the environment's P is not what step does: state 3, action 0: "
        "P says state 2 with reward -1.0, step gave state 1 with reward -1.0"
    )


def test_a_wrong_frequency_is_named():
    refusal = check_transition_model(Corridor(outcomes(wind=0.4))).refusal
    found = re.search(r"in (\d+\.\d)% of cases, step gave it in (\d+\.\d)% of [\d,]+$", refusal)
    assert float(found[1]) in {40.0, 60.0}
    assert abs(float(found[2]) - {40.0: 30, 60.0: 70}[float(found[1])]) < 5


def test_a_wrong_frequency_of_a_single_action():
    table = outcomes()
    table[2][0] = [(0.6, *table[2][0][0][1:]), (0.4, *table[2][0][1][1:])]
    refusal = check_transition_model(Corridor(table)).refusal
    assert "state 2, action 0: P says state 1 with reward -1.0 in 60.0% of cases" in refusal


@pytest.mark.parametrize("start", [(0.9, 0.1, 0, 0, 0), (0, 1, 0, 0, 0)])
def test_wrong_starts(start):
    refusal = check_transition_model(Corridor(start=start), n_steps=20_000).refusal
    assert "initial_state_distrib" in refusal


class Streak(Corridor):
    """Wind is likelier after wind; both are as frequent as P says in the long run."""

    blew = 0

    def draw(self, row):
        self.blew = int(self.np_random.random() < (0.6 if self.blew else 0.4))
        return self.blew


class Stormy(Corridor):
    """Wind changes with the number of steps of an episode, and is stronger than P says."""

    def draw(self, row):
        return int(self.np_random.random() < (0.2 if self.steps < 8 else 0.8))


class Moody(Corridor):
    """Rewards depend on the step."""

    def step(self, action):
        obs, reward, *rest = super().step(action)
        return obs, reward - (self.steps > 60), *rest


class Turns(Corridor):
    """Starts take turns."""

    last = 1

    def first(self):
        self.last = 1 - self.last
        return self.last


@pytest.mark.parametrize("kind", [Stormy, Moody])
def test_what_depends_on_more_than_the_state_is_found_where_it_shows(kind):
    assert check_transition_model(kind()).refusal is not None


def test_what_only_shows_in_the_order_of_things_is_believed():
    """A model has no memory, and the check does not ask for any."""
    right = outcomes(wind=0.5)
    for env in (Streak(right, right), Turns(start=(0.5, 0.5, 0, 0, 0))):
        assert check_transition_model(env, n_steps=FEW).refusal is None


class Chooser(Corridor):
    """Right, and draws in its own way."""

    def draw(self, row):
        return int(self.np_random.choice(2, p=[outcome[0] for outcome in row]))


class Backwards(Corridor):
    def draw(self, row):
        return int(self.np_random.random() < row[1][0])


class Thrifty(Corridor):
    """Draws for steps alone."""

    def first(self):
        return 0


class Careless(Corridor):
    """Draws from NumPy's global generator."""

    def draw(self, row):
        return int(np.random.random() < row[1][0])  # noqa: NPY002


@pytest.mark.parametrize("kind", [Backwards, Thrifty, Careless])
def test_right_ones_that_draw_in_their_own_way(kind):
    check = check_transition_model(kind(), n_steps=FEW)
    assert check.refusal is None
    assert not check.bit_for_bit
    assert check.state_can_be_set


class LateStart(Corridor):
    """Draws its starts alone in its own way."""

    def first(self):
        return int(self.np_random.random() < 0.5)


def test_starts_and_successors_are_predicted_too():
    starts = LateStart(start=(0.5, 0.5, 0, 0, 0))
    same_rewards = outcomes(goal_reward=-1.0)
    for env in (starts, Backwards(same_rewards, same_rewards)):
        check = check_transition_model(env, n_steps=FEW)
        assert check.refusal is None
        assert not check.bit_for_bit


def test_choice_draws_as_toy_text_does():
    assert check_transition_model(Chooser(), n_steps=FEW).bit_for_bit


def test_what_has_nothing_to_draw_is_the_same_bit_for_bit():
    calm = outcomes(wind=0.0)
    for row in (row for rows in calm.values() for row in rows.values()):
        row.pop()
    assert check_transition_model(Thrifty(calm, calm), n_steps=FEW).bit_for_bit


class Twins(gym.Env):
    """Outcomes that look alike in single precision: as ``P`` says, or the first one instead."""

    action_space = spaces.Discrete(1)
    observation_space = spaces.Discrete(2)
    P = {  # noqa: RUF012
        0: {0: [(0.25, 1, 0.1, False), (0.5, 0, 0.1, False), (0.25, 1, 0.1, False)]},
        1: {0: [(0.5, 0, 0.3, False), (0.5, 0, 0.1 + 0.2, False)]},
    }
    initial_state_distrib = np.array([1.0, 0.0])

    def __init__(self, exact):
        self.exact = exact
        self.s = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = int(categorical_sample(self.initial_state_distrib, self.np_random))
        return self.s, {}

    def step(self, action):
        row = self.P[self.s][action]
        chosen = categorical_sample([outcome[0] for outcome in row], self.np_random)
        reward = row[chosen if self.exact else 0][2]
        self.s = row[chosen][1]
        return self.s, reward, False, False, {}


def test_rewards_are_told_apart_in_full_precision_only_bit_for_bit():
    for exact in (True, False):
        check = check_transition_model(Twins(exact), n_steps=FEW)
        assert check.refusal is None
        assert check.bit_for_bit is exact


class Unsettable(Corridor):
    """Its place is not ``s``."""

    @property
    def s(self):
        return self.place

    @s.setter
    def s(self, place):
        if hasattr(self, "place"):
            raise AttributeError
        self.place = place

    def step(self, action):
        row = self.true[self.place][action]
        _, self.place, reward, terminated = row[self.draw(row)]
        return self.place, reward, terminated, False, {}

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        self.place = self.first()
        return self.place, {}


class Deaf(Corridor):
    """Lets ``s`` be set, and goes on from where it was."""

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed)
        self.place = obs
        return obs, info

    def step(self, action):
        self.s = self.place
        result = super().step(action)
        self.place = self.s
        return result


class Torn(Corridor):
    """Goes on from ``s``, and rewards by where it thinks that it is."""

    place = 0

    def reset(self, *, seed=None, options=None):
        self.place, info = super().reset(seed=seed)
        return self.place, info

    def step(self, action):
        before, self.place = self.place, None
        self.place, reward, *rest = super().step(action)
        surprised = abs(self.place - before) > 2
        return self.place, reward - surprised, *rest


class Elsewhere(Unsettable):
    """``s`` is its size."""

    s = 5

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.place = 0


@pytest.mark.parametrize("kind", [Unsettable, Deaf, Torn, Elsewhere])
def test_states_that_cannot_be_set(kind):
    check = check_transition_model(kind(), n_steps=FEW)
    assert check.refusal is None
    assert check.bit_for_bit
    assert not check.state_can_be_set
    far = outcomes()
    far[3][0][0] = (0.7, 2, -2.0, False)
    assert "state 3, action 0" in check_transition_model(kind(far, outcomes()), FEW).refusal


class Odd(Corridor):
    def __init__(self, how, **kwargs):
        self.how = how
        super().__init__(**kwargs)

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        match self.how:
            case "truncates":
                truncated = self.steps == 20
            case "raises":
                if self.s == 3:
                    raise RuntimeError("one\ntwo")
            case "short":
                return obs, reward, terminated, info
            case "nothing":
                reward = float("nan")
            case "text":
                reward = "much"
        return obs, reward, terminated, truncated, info

    def observe(self):
        match self.how:
            case "shifted":
                return self.s + 1
            case "pair":
                return (0, self.s)
            case "float":
                return float(self.s)
        return self.s


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("truncates", "step gave truncated, which no model holds: leave time limits to"),
        ("raises", "step raised RuntimeError: one two"),
        ("short", "step raised ValueError: not enough values"),
        ("nothing", "step gave state 1 with reward nan"),
        ("text", "step raised ValueError: could not convert string"),
        ("shifted", "reset gave state 1, where initial_state_distrib says"),
        ("pair", "the observation is (0, 0), not the number of a state"),
        ("float", "the observation is 0.0, not the number of a state"),
    ],
)
def test_odd_environments_are_refused_in_one_line(how, reason):
    refusal = check_transition_model(Odd(how)).refusal
    assert reason in refusal
    assert "\n" not in refusal


def test_what_random_play_hardly_ever_reaches_is_found():
    """Each wrong step leads back to the start: 1 in 30,000 random tries comes to the last state."""

    def ladder(reward):
        table = {
            s: {0: [(1.0, 0, 0.0, False)], 1: [(1.0, min(s + 1, 15), 0.0, s == 15)]}
            for s in range(16)
        }
        table[15][1] = [(1.0, 15, reward, True)]
        return table

    start = np.eye(16)[0]
    for kind in (Corridor, Unsettable):
        assert check_transition_model(kind(ladder(1.0), ladder(1.0), start), FEW).refusal is None
        refusal = check_transition_model(kind(ladder(2.0), ladder(1.0), start), FEW).refusal
        assert "state 15, action 1: P says state 15 with reward 2.0, terminated" in refusal


class Pictured(Corridor):
    """What is observed is no number."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.observation_space = spaces.Box(0, 1, (5,))

    def observe(self):
        return np.eye(5, dtype=np.float32)[self.s]


def test_states_are_read_where_observations_are_no_numbers():
    assert check_transition_model(Pictured(), n_steps=FEW).refusal is None
    assert transition_model(Pictured()) is not None
    assert observations_of_states(Pictured()) is None
    assert "state 3" in check_transition_model(Pictured(altered(reward=10.0))).refusal


def test_spaces_must_fit():
    env = Corridor()
    env.observation_space = spaces.Discrete(6)
    refusal = check_transition_model(env).refusal
    assert refusal == (
        "the environment's P is no model: it has 5 states, where the space is Discrete(6)"
    )
    assert model_check(env).refusal == refusal
    assert observations_of_states(env) is None
    env = Corridor()
    env.action_space = spaces.Discrete(3)
    assert "it has 2 actions, where the space is Discrete(3)" in check_transition_model(env).refusal


@pytest.mark.parametrize(
    "told", [{}, {0: {}}, {1: {0: [(1.0, 0, 0.0, False)]}}, {0: {0: [(1.0,)]}}]
)
def test_what_is_no_model_is_refused_in_one_line(told):
    env = Corridor()
    env.P = told
    assert "the environment's P is no model" in check_transition_model(env).refusal


def test_an_environment_without_a_model_cannot_be_checked():
    with pytest.raises(ValueError, match="brings no model to check"):
        check_transition_model(gym.make("CartPole-v1"))


def test_the_caller_notices_nothing():
    env = gym.wrappers.TimeLimit(Corridor(), 50)
    env.reset(seed=7)
    env.step(1)
    random.seed(3)
    np.random.seed(3)  # noqa: NPY002
    before = copy.deepcopy((vars(env), vars(env.unwrapped), env.np_random.bit_generator.state))
    shared = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    check_transition_model(env, n_steps=FEW)
    assert transition_model(env) is not None
    assert pickle.dumps(before[1]["true"]) == pickle.dumps(env.unwrapped.true)
    assert before[0]["_elapsed_steps"] == vars(env)["_elapsed_steps"]
    assert (before[1]["s"], before[1]["steps"]) == (env.unwrapped.s, env.unwrapped.steps)
    assert before[2] == env.np_random.bit_generator.state
    assert shared == (random.getstate(), np.random.get_state()[1].tolist())  # noqa: NPY002


def test_nothing_is_drawn_on_the_screen():
    assert check_transition_model(Corridor(render_mode="human"), n_steps=FEW).refusal is None


class Locked(Corridor):
    """Cannot be copied."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.lock = threading.Lock()


gym.register("Locked-v0", entry_point=Locked)


def test_what_cannot_be_copied_is_made_anew():
    env = gym.make("Locked-v0", true=outcomes(wind=0.5), render_mode="human")
    assert check_transition_model(env, n_steps=FEW).refusal is None
    assert "cannot be held against step: it cannot be copied" in (
        check_transition_model(Locked()).refusal
    )
    env.unwrapped.P = outcomes()
    assert "made in the same way has another P" in check_transition_model(env).refusal


def test_a_method_replaced_by_hand_is_not_tried():
    env = FrozenLakeEnv()
    original = env.step
    env.step = lambda action: original(0)
    assert "its step was replaced by hand" in model_check(env).refusal
    assert transition_model(env) is None
    assert success_outcomes(env) is None


class Same(FrozenLakeEnv):
    """Steps as its class does, by a method of its own."""

    def step(self, action):
        return super().step(action)


class Frozen(FrozenLakeEnv):
    def step(self, action):
        return super().step(0)


class Rosy(FrozenLakeEnv):
    """Tells another P than it was made with."""

    @property
    def P(self):  # noqa: N802
        return {
            s: {a: [(p, n, r + 1, t) for p, n, r, t in row] for a, row in rows.items()}
            for s, rows in self.inner.items()
        }

    @P.setter
    def P(self, P):  # noqa: N802, N803
        self.inner = P

    def step(self, action):
        outcomes = self.inner[self.s][action]
        i = categorical_sample([outcome[0] for outcome in outcomes], self.np_random)
        _, self.s, reward, terminated = outcomes[i]
        return int(self.s), reward, terminated, False, {}


class Detour(WarehouseEnv):
    def step(self, action):
        return super().step(3 - action)


class Renamed(WarehouseEnv):
    def observation_of(self, states):
        return (states + 1) % self.dynamics.n_states


@pytest.mark.parametrize("kind", [Frozen, Rosy, Detour, Renamed])
def test_subclasses_of_known_classes_are_checked(kind):
    env = kind()
    assert model_check(env).refusal is not None
    assert transition_model(env) is None
    assert success_outcomes(env) is None
    assert observations_of_states(env) is None


def test_a_subclass_that_does_the_same_is_believed():
    ours, known = (transition_model(env) for env in (Same(), FrozenLakeEnv()))
    np.testing.assert_array_equal(ours.prob, known.prob)
    assert transition_model(type("Plain", (WarehouseEnv,), {})(slip=0.1)) is not None


def count_checks(monkeypatch):
    done = []
    real = checking._check
    monkeypatch.setattr(
        checking, "_check", lambda base, *args: done.append(base) or real(base, *args)
    )
    return done


def test_each_environment_is_checked_once(monkeypatch):
    done = count_checks(monkeypatch)
    for seed in range(3):
        env = gym.wrappers.TimeLimit(Corridor(), 50)
        env.unwrapped.observation_space.seed(seed)
        env.unwrapped.rng = np.random.default_rng(seed)
        for _ in range(3):
            env.reset(seed=seed)
            env.step(1)
            assert transition_model(env) is not None
            assert observations_of_states(env) is not None
    assert len(done) == 1


def test_an_environment_that_was_changed_is_checked_again(monkeypatch):
    done = count_checks(monkeypatch)
    env = Corridor()
    assert transition_model(env) is not None
    env.true = outcomes(wind=0.6)
    assert transition_model(env) is None
    env.P = outcomes(wind=0.6)
    assert transition_model(env) is not None
    assert transition_model(Corridor(goal := outcomes(goal_reward=3.0), goal)) is not None
    assert len(done) == 4


def test_what_cannot_be_written_down_is_told_apart(monkeypatch):
    done = count_checks(monkeypatch)
    for wind in (0.3, 0.3, 0.6):
        env = Corridor(outcomes(), outcomes(wind))
        env.note = lambda: None
        assert (transition_model(env) is None) is (wind == 0.6)
    assert len(done) == 3


def test_a_model_that_cannot_be_written_down_is_told_apart(monkeypatch):
    done = count_checks(monkeypatch)
    env = Corridor()
    env.P = defaultdict(lambda: None, outcomes())
    assert transition_model(env) is not None
    assert transition_model(env) is not None
    env.P[3][1] = altered(reward=10.0)[3][1]
    assert transition_model(env) is None
    assert len(done) == 2


def test_a_check_comes_out_the_same_every_time():
    first, again = (
        check_transition_model(Careless(outcomes(0.4), outcomes()), n_steps=20_000)
        for _ in range(2)
    )
    assert first == again
    assert first.refusal is not None


def test_the_package_exports_the_check():
    assert envs.check_transition_model is checking.check_transition_model
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = envs.nothing

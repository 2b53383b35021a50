"""Agents on tables work with all finite spaces: the same tables, and the original observations."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from rl_yardstick import mdp
from rl_yardstick.agents.tabular.q_learning_and_sarsa import SARSA, QLearning
from rl_yardstick.envs.finite_spaces import Bijection, describe
from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.envs.wrappers import FlattenToDiscrete

same = np.testing.assert_equal
BOX, PAIR = spaces.Box(-1, 2, (2,), np.int64), spaces.MultiDiscrete([2, 2], start=[0, -3])
# Of observations and of actions; the first have 16 members or more, the second four.
SPACES = {
    "start": (spaces.Discrete(20, start=-7), spaces.Discrete(4, start=3)),
    "many": (spaces.MultiDiscrete([4, 5], start=[2, -1]), spaces.MultiDiscrete([2, 2])),
    "board": (spaces.MultiDiscrete([[2, 2], [3, 2]]), spaces.MultiBinary(2)),
    "bits": (spaces.MultiBinary([2, 2]), PAIR),
    "box": (BOX, spaces.Box(0, 1, (2, 1), np.uint8)),
    "tuple": (spaces.Tuple([spaces.Discrete(4, start=1), PAIR]), spaces.Tuple([PAIR])),
    "dict": (spaces.Dict(b=spaces.Discrete(2), a=BOX), spaces.Dict(go=spaces.Discrete(4))),
    "nested": (spaces.Dict(x=spaces.Tuple([PAIR, spaces.Dict(y=PAIR)]), z=spaces.MultiBinary(1)),
               spaces.Discrete(4)),
}  # fmt: skip


def members_of(space):
    """All members, the last part counting fastest."""
    if isinstance(space, spaces.Discrete):
        return [space.start + i for i in range(space.n)]
    if isinstance(space, spaces.Tuple | spaces.Dict):
        keys = space.spaces if isinstance(space, spaces.Dict) else range(len(space.spaces))
        parts = itertools.product(*(members_of(space[key]) for key in keys))
        made = [dict(zip(keys, part, strict=True)) for part in parts]
        return made if isinstance(space, spaces.Dict) else [tuple(one.values()) for one in made]
    low = getattr(space, "low", getattr(space, "start", np.zeros(space.shape, int)))
    high = space.high + 1 if isinstance(space, spaces.Box) else low + getattr(space, "nvec", 2)
    rows = itertools.product(*map(range, low.ravel().tolist(), high.ravel().tolist()))
    return [np.array(row, space.dtype).reshape(space.shape) for row in rows]


def stacked(parts):
    """Members as a batch, as a VecEnv gives it."""
    if isinstance(parts[0], dict):
        return {key: stacked([part[key] for part in parts]) for key in parts[0]}
    if isinstance(parts[0], tuple):
        return tuple(stacked(column) for column in zip(*parts, strict=True))
    return np.array(parts)


class Lake(gym.Wrapper):
    """FrozenLake whose states and actions are members of other spaces."""

    def __init__(self, observations, actions):
        super().__init__(gym.make("FrozenLake-v1").unwrapped)
        self.observation_space, self.action_space = observations, actions
        self.seen, self.done = members_of(observations), members_of(actions)
        self.number = Bijection(actions).number

    def reset(self, **kwargs):
        state, info = self.env.reset(**kwargs)
        return self.seen[state], info

    def step(self, action):
        assert self.action_space.contains(action)
        state, *rest = self.env.step(self.number(action))
        return self.seen[state], *rest


def check(space, members, numbers):
    numbering = Bijection(space)
    assert [*map(numbering.number, members)] == numbers
    assert numbering.numbers(stacked(members)).tolist() == numbers
    same([*map(numbering.member, numbers)], members)
    same(numbering.members(numbers), stacked(members))
    assert all(map(space.contains, map(numbering.member, numbers)))
    assert numbering.is_batch(stacked(members)) > any(map(numbering.is_batch, members))


@pytest.mark.parametrize("name", SPACES)
def test_each_member_has_a_number_and_comes_back(name):
    for space in SPACES[name]:
        members = members_of(space)
        assert Bijection(space).numbers_space == spaces.Discrete(len(members))
        check(space, members, [*range(len(members))])


@pytest.mark.parametrize(("name", "algorithm"), [*zip(SPACES, [QLearning, SARSA] * 4, strict=True)])
def test_the_table_is_that_of_an_environment_flattened_by_hand(name, algorithm, tmp_path):
    settings, env = {"seed": 3, "initial_q_std": 0.1}, Lake(*SPACES[name])
    by_hand = Lake(*(spaces.Discrete(len(members)) for members in (env.seen, env.done)))
    agent, other = (algorithm(env=one, **settings).learn(800) for one in (env, by_hand))
    assert agent.policy.visit_counts.sum() == 800
    same(agent.policy.q_tables.numpy(), other.policy.q_tables.numpy())
    agent.save(tmp_path / "agent")
    loaded = algorithm.load(tmp_path / "agent")
    numbers, _ = other.predict(np.arange(16), deterministic=True)
    for state, number in enumerate(numbers):
        action, _ = loaded.predict(env.seen[state], deterministic=True)
        same(action, env.done[number])
        assert env.action_space.contains(action)
    many, _ = loaded.predict(stacked(env.seen[:16]), deterministic=True)
    same(list(many), [env.done[number] for number in numbers])
    # The exact values of both policies, by the model of FrozenLake.
    model, chosen = transition_model(gym.make("FrozenLake-v1")), np.array([*map(env.number, many)])
    first, second = (mdp.policy_return(model, policy, 100) for policy in (chosen, numbers))
    assert first.expected_return == second.expected_return


@pytest.mark.parametrize("name", ["start", "dict", "many"])
def test_predict_takes_what_the_given_environment_shows(name, tmp_path):
    env = gym.wrappers.TimeLimit(Lake(*SPACES[name]), 20)
    agent = QLearning(env=env, seed=0).learn(200)
    assert agent.get_env().observation_space == SPACES[name][0]
    for where in (agent.get_env(), env):
        evaluate_policy(agent, where, 3, warn=False)
    agent.save(tmp_path / "agent")
    for given_env in (env, FlattenToDiscrete(env), DummyVecEnv([lambda: FlattenToDiscrete(env)])):
        loaded = QLearning.load(tmp_path / "agent", env=given_env)
        loaded.learn(50, reset_num_timesteps=False)
        evaluate_policy(loaded, loaded.get_env(), 2, warn=False)
    loaded.set_env(env)
    assert env.action_space.contains(loaded.predict(env.reset()[0], deterministic=True)[0])


NESTED = st.recursive(
    st.builds(spaces.Discrete, st.integers(1, 4), start=st.integers(-9, 9))
    | st.builds(lambda low: spaces.Box(low, low + 2, (2,), np.int16), st.integers(-100, 100))
    | st.sampled_from([PAIR, spaces.MultiBinary(2)]),
    lambda part: (
        st.lists(part, min_size=1, max_size=3).map(spaces.Tuple)
        | st.dictionaries(st.text("abc", min_size=1), part, min_size=1, max_size=3).map(spaces.Dict)
    ),
    max_leaves=5,
)


@given(NESTED, st.integers(0, 99))
def test_members_of_any_nested_space_come_back(space, seed):
    space.seed(seed)
    drawn = [space.sample() for _ in range(5)]
    check(space, drawn, [*map(Bijection(space).number, drawn)])
    assert len(describe(space)) <= 80


@pytest.mark.parametrize("observation", [(13, 10, 2), (13, 10), (13, 9.5, 0), ([13], [11], [0])])
def test_observations_of_another_space_are_refused(observation):
    with pytest.raises(ValueError, match=r"is not in Tuple\(Discrete\(32\), "):
        QLearning(env="Blackjack-v1").predict(observation)


def test_environments_that_do_not_fit_name_the_way_out(tmp_path):
    with pytest.raises(ValueError, match=r"wrap each environment in rl_yardstick.envs.wrappers.Fl"):
        QLearning(env=DummyVecEnv([lambda: Lake(*SPACES["many"])]))
    agent = QLearning(env=Lake(spaces.Discrete(16), spaces.MultiDiscrete([2, 2])))
    agent.save(tmp_path / "agent")
    with pytest.raises(ValueError, match="the agent learnt on"):
        QLearning.load(tmp_path / "agent", env=Lake(spaces.Discrete(16), spaces.MultiBinary(2)))


@pytest.mark.parametrize("space", [spaces.Discrete(3, start=1), spaces.MultiBinary(10**12), BOX, 5])
def test_a_file_with_other_spaces_is_refused(space, tmp_path):
    agent = QLearning(env=Lake(spaces.Discrete(16), PAIR))
    agent.original_spaces = (agent.observation_space, space)
    agent.save(tmp_path / "agent")
    with pytest.raises(ValueError, match=r"do not number|not finite"):
        QLearning.load(tmp_path / "agent")

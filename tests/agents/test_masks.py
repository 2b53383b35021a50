"""Agents among the actions that the environment allows: tables, bandits and deep Q-learning."""

import math

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.special import softmax
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.agents.bandits.algorithm import Pull
from rl_yardstick.agents.library import DQN, DoubleDQN
from rl_yardstick.envs import found_models
from rl_yardstick.envs.known_models import action_masks_of_states
from rl_yardstick.envs.wrappers import ActionMasks
from tests.agents.hand_fed import feed

# The others choose by the same functions.
BANDITS = ["epsilon_greedy", "ucb", "gradient_bandit", "exp3", "thompson", "linucb"]
TABULAR = [name for name, entry in ALGORITHMS.items() if entry.family == "tabular"]
OPTIMISTIC = ("r_max", "qlearning_ucb")  # which explore in a way of their own
UNIFORM = {"exploration_decay": "constant", "exploration_initial_eps": 1.0}
C, A = 3, 4
BY_CONTEXT = np.array([[1, 0, 1, 1], [0, 1, 1, 0], [0, 0, 0, 1]], bool)
EVERYTHING = np.ones((C, A), bool)


class Shop(gym.Env):
    """Customers of three segments; rewards are coins. What is masked must not be done."""

    observation_space, action_space = spaces.Discrete(C), spaces.Discrete(A)

    def __init__(self, masks=BY_CONTEXT, batch=1, limit=7):
        self.masks, self.batch, self.limit = np.asarray(masks, bool), batch, limit
        self.day = self.context = 0

    def action_masks(self):
        return self.masks[self.context]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.day, self.context = 0, int(self.np_random.integers(C))
        return self.context, {}

    def step(self, action):
        assert self.action_masks()[action], f"{action} is sold out in {self.context}"
        self.day, self.context = self.day + 1, int(self.np_random.integers(C))
        reward = float(self.np_random.random() < 0.2 * (1 + action))
        is_due = self.day % self.batch == 0
        return self.context, reward, False, self.day == self.limit, {"feedback_due": is_due}


@pytest.fixture(autouse=True, scope="module")
def masks_are_met_and_not_searched_for():
    """To find the model of each shop takes longer than to learn in it."""
    found_models.limit("none")
    yield
    found_models.limit("auto")


def in_shop(name, masks=BY_CONTEXT, n_envs=1, **kwargs):
    env = DummyVecEnv([lambda: Shop(masks)] * n_envs)
    return load_algorithm(name)(env=env, **{"seed": 0, "mask_actions": True, **kwargs})


TIES = ("random", "first")
GREEDILY = {"exploration_initial_eps": 0.5, "exploration_decay": "constant"}
TRIED = {
    **{name: GREEDILY for name in TABULAR if name not in OPTIMISTIC},
    **{key: {} for key in OPTIMISTIC},
    "sarsa, boltzmann": {"exploration": "boltzmann", "temperature": 0.5},
    "sarsa, gaussian": {"exploration": "gaussian_noise", "noise_std": 20.0},
}


@pytest.mark.parametrize("row", TRIED)
@settings(max_examples=4, derandomize=True)
@given(bits=hnp.arrays(int, (C, 1), elements=st.integers(1, 2**A - 1)), ties=st.sampled_from(TIES))
def test_a_masked_action_is_never_chosen(row, bits, ties):
    allowed = bits >> np.arange(A) & 1 == 1
    # Tables full of noise: what is best is mostly masked. The environment itself refuses.
    noisy = {"tie_breaking": ties, **({"initial_q_std": 5.0} if TRIED[row] else {}), **TRIED[row]}
    agent = in_shop(row.partition(",")[0], allowed, 2, **noisy).learn(60)
    obs = np.arange(C).repeat(20)
    for deterministic in (True, False):
        told = agent.predict(obs, deterministic=deterministic, action_masks=allowed[obs])[0]
        assert allowed[obs, told].all()
    if row.startswith("sarsa") and "gaussian" not in row:
        met = agent.policy.masks.any(axis=1)
        probabilities = agent.action_probabilities()
        assert not probabilities[met][~allowed[met]].any()
        np.testing.assert_allclose(probabilities.sum(axis=1), 1)


ALLOWED, ARM_TABLES = [1, 3], {"counts", "sums", "scores", "coefficients"}


def fewer(env):
    """With the two of the actions alone that are allowed."""
    return gym.wrappers.TransformAction(env, ALLOWED.__getitem__, spaces.Discrete(len(ALLOWED)))


@pytest.mark.parametrize("name", BANDITS)
def test_masked_arms_might_as_well_not_be_there(name):
    """All that is learnt of the others, and all that is drawn, is as without them.

    And the shop refuses what it does not sell.
    """
    masks, ends = np.tile(np.isin(np.arange(A), ALLOWED), (C, 1)), []
    for masked in (True, False):
        shop = Shop(masks, 3)
        env = DummyVecEnv([lambda shop=shop, masked=masked: shop if masked else fewer(shop)])
        model = load_algorithm(name)(env=env, seed=3, mask_actions=masked).learn(500)
        for deterministic in (True, False) if masked else ():  # by the masks that it has kept
            arms = model.predict(np.arange(C).repeat(10), deterministic=deterministic)[0]
            assert set(arms.tolist()) <= set(ALLOWED)
        tables = model.policy.state_dict()
        found = {key: tables[key].numpy() for key in ARM_TABLES & tables.keys()}
        if "coefficients" in found:  # a row for each arm
            found = {key: value.T for key, value in found.items()}
        chosen = ALLOWED if masked else slice(None)
        found = {key: value[..., chosen].tolist() for key, value in found.items()}
        ends.append((found, model._last_obs.tolist(), model.rng.bit_generator.state))
    assert ends[0] == ends[1]


def test_a_zip_brings_the_masks_back(tmp_path):
    model = in_shop("dyna_q_plus").learn(200)
    model.save(tmp_path / "agent")
    loaded = type(model).load(tmp_path / "agent")
    met = model.policy.masks.any(axis=1)
    assert loaded.mask_actions
    assert met.sum() >= 2
    assert np.array_equal(model.policy.masks[met], BY_CONTEXT[met])
    assert np.array_equal(loaded.policy.masks, model.policy.masks)


# Of the next state's values the best one, of action 3, is masked, and so is that of action 0.
VALUES, OTHERS = [10.0, 4.0, 2.0, 50.0], [0.0, -7.0, 8.0, 90.0]
NEXT_MASKS = np.array([[1, 1, 1, 1], [0, 1, 1, 0], [1, 1, 1, 1]], bool)
SOFTMAX = 1 / (1 + np.exp(-1.0))  # of action 1 at temperature 2
TARGETS = {  # agent: settings, targets
    "qlearning": ({}, {3 + 0.5 * 4}),
    # Half of the time a random one of two, of mean 3, else the better, 4.
    "expected_sarsa": ({**UNIFORM, "exploration_initial_eps": 0.5}, {3 + 0.5 * 3.5}),
    "expected_sarsa, boltzmann": (
        {"exploration": "boltzmann", "temperature": 2.0},
        {3 + 0.5 * (4 * SOFTMAX + 2 * (1 - SOFTMAX))},
    ),
    "q_lambda": ({"trace_decay": 0.0}, {3 + 0.5 * 4}),
    "sarsa": (UNIFORM, {3 + 0.5 * 4, 3 + 0.5 * 2}),
    # Of the allowed, the first table prefers action 1 and the second action 2.
    "double_qlearning": ({}, {3 + 0.5 * -7, 3 + 0.5 * 2}),
}


@pytest.mark.parametrize("row", TARGETS)
def test_targets_are_those_of_the_allowed_actions(row):
    name, (own, targets), found = row.partition(",")[0], TARGETS[row], set()
    for seed in range(9):
        agent = in_shop(name, NEXT_MASKS, learning_rate=1.0, gamma=0.5, **{**own, "seed": seed})
        agent.learn(0)
        q_tables = agent.policy.q_tables.numpy()
        for q_table, values in zip(q_tables, (VALUES, OTHERS), strict=False):
            q_table[:], q_table[1] = 0, values
        agent.policy.note_masks(np.arange(C), NEXT_MASKS)
        agent.masks_are_known = True
        feed(agent, 0, 1, 3, 1)
        (value,) = q_tables[:, 0, 1][q_tables[:, 0, 1] != 0]
        found.add(round(value, 12))
        assert name != "sarsa" or value == 3 + 0.5 * VALUES[agent._next_actions[0]]
    assert found == {round(target, 12) for target in targets}


def knowing(name, scores, counts=(1,) * A, **kwargs):
    """An agent with these scores, taken for average rewards, in context 0."""
    model = in_shop(name, **kwargs)
    tables = model.policy.tables
    tables.scores[0], tables.counts[0] = scores, counts
    tables.sums[0] = np.where(tables.counts[0], tables.scores[0], 0) * tables.counts[0]
    return model


def shares(model, mask, n=20_000):
    """How often an exploring agent pulls each arm in context 0."""
    masks = np.tile(np.array(mask, bool), (n, 1))
    arms = model.predict(np.zeros(n, int), deterministic=False, action_masks=masks)[0]
    return np.bincount(arms, minlength=A) / n


def test_bounds_count_all_pulls_of_the_context():
    """Source: the awake upper estimated rewards of Kleinberg, Niculescu-Mizil and Sharma, 2010."""
    means, counts = np.array([0.6, 0.3, 0.9, 0.0]), np.array([50, 20, 9000, 1000])

    def best(pulls):
        return np.argmax(means[:2] + np.sqrt(2 * math.log(pulls) / counts[:2]))

    # After the pulls of the allowed arms alone it would be the first.
    assert (best(counts[:2].sum()), best(counts.sum())) == (0, 1)
    assert shares(knowing("ucb", means, counts), [1, 1, 0, 0], 10).tolist() == [0, 1, 0, 0]
    # An arm that was not tried yet waits until it is allowed.
    model = knowing("ucb", [0.1, 0.9, -np.inf, -np.inf], [5, 5, 0, 0])
    assert shares(model, [1, 1, 0, 0], 10).tolist() == [0, 1, 0, 0]
    assert shares(model, [1, 1, 0, 1], 10).tolist() == [0, 0, 0, 1]


def test_gradient_step_among_the_arms_of_the_pull():
    model = knowing("gradient_bandit", [2.0, 0.5, -1.0, 1.0], [2, 1, 0, 1], learning_rate=0.5)
    model.policy.tables.sums[0] = [1.0, 3.0, 0.0, 4.0]
    model._learn(Pull(0, 3, 5.0, 1.0, [False, True, False, True]))
    less, more = softmax([0.5, 1.0])
    advantage = 0.5 * (5.0 - 2.0)  # the average of four rewards, two of them of a masked arm
    expected = [2.0, 0.5 - advantage * less, -1.0, 1.0 + advantage * (1 - more)]
    assert model.policy.scores[0].tolist() == pytest.approx(expected, rel=1e-14)
    assert model.policy.counts[0].tolist() == [2, 1, 0, 2]
    assert model.policy.sums[0].tolist() == [1.0, 3.0, 0.0, 9.0]


SMALL = {"seed": 0, "learning_starts": 50, "policy_kwargs": {"net_arch": [8]}}
MASKED = {"policy": "MlpPolicy", "mask_actions": True, "buffer_size": 1000, **SMALL}


def warehouse(n_envs=1):
    env_kwargs = {"max_episode_steps": 25}
    return make_vec_env("Warehouse-v0", n_envs, 0, env_kwargs=env_kwargs, wrapper_class=ActionMasks)


def test_deep_agents_do_nothing_masked_and_keep_the_next_masks(tmp_path):
    env = warehouse(n_envs=2)
    DQN(env=env, **{**MASKED, "mask_actions": False}).save(tmp_path / "plain")
    changed = {"mask_actions": True, "exploration_final_eps": 0.5}
    agent = DQN.load(tmp_path / "plain", env=env, **changed).learn(900)
    agent.save(tmp_path / "agent")
    loaded = DQN.load(tmp_path / "agent", env=env).learn(60)
    assert loaded.mask_actions
    masks = action_masks_of_states(env.envs[0])
    for one in (agent, loaded):
        buffer = one.replay_buffer
        seen = slice(0, buffer.pos)
        obs, after = buffer.observations[seen, :, 0], buffer.next_observations[seen, :, 0]
        actions, kept = buffer.actions[seen, :, 0], buffer.actions[seen, :, 1:]
        assert masks[obs, actions].all()
        going_on = buffer.dones[seen] * (1 - buffer.timeouts[seen]) == 0
        np.testing.assert_array_equal(kept[going_on], masks[after][going_on])
    # Cut-off episodes too, whose environments have been reset by then.
    assert agent.replay_buffer.timeouts.sum() > 20
    plain = DQN.load(tmp_path / "agent", env=env, mask_actions=False).learn(60)
    assert type(plain.replay_buffer) is stable_baselines3.common.buffers.ReplayBuffer


# In state 1 actions 1 and 2 are allowed: the target network's best value of them; or its value of
# the one that the online network prefers.
@pytest.mark.parametrize(("algorithm", "expected"), [(DQN, 6.0), (DoubleDQN, -2.0)])
def test_deep_targets_by_hand(algorithm, expected):
    env, settings = ActionMasks(Shop(NEXT_MASKS)), {**MASKED, "learning_starts": 0}
    agent = algorithm(env=env, **settings).learn(40)
    online, target = th.zeros(2, C, A)
    online[1], target[1] = th.tensor([[9.0, 1, 3, 9], [70.0, 6, -2, 70]])
    agent.q_net = lambda obs: online[obs[:, 0].long()]
    batch = agent.replay_buffer.sample(64)
    values = agent._next_values(lambda obs: target[obs[:, 0].long()])(batch.next_observations)
    in_state_1 = batch.next_observations[:, 0] == 1
    assert 0 < in_state_1.sum() < 64
    assert set(values.amax(dim=1)[in_state_1].tolist()) == {expected}
    assert set(values.amax(dim=1)[~in_state_1].tolist()) == {0.0}


def told(name, masks):
    """An agent whose environment says this in states other than 0."""
    agent = in_shop(name, EVERYTHING)
    env = agent.env.envs[0]
    env.action_masks = lambda: masks(env) if env.context else np.ones(A)
    return agent


REFUSALS = [
    (lambda: in_shop("ucb").predict([0, 1], action_masks=BY_CONTEXT),
     r"action_masks must be of shape \(2, 4\), not \(3, 4\)"),
    *((lambda name=name: told(name, lambda env: np.zeros(A)).learn(99),
       r"the action mask for observation \d allows no action") for name in ("sarsa", "ucb")),
    (lambda: told("sarsa", lambda env: np.arange(A) != env.day % A).learn(100),
     r"observation \d comes with different action masks"),
    (lambda: in_shop("sarsa", EVERYTHING, engine="compiled").learn(10),
     "engine: compiled is not possible: the action masks are not known of all states"),
    (lambda: DQN(env="Warehouse-v0", **MASKED).learn(10),
     "mask_actions of DQN: info holds no action_mask, "),
]  # fmt: skip


@pytest.mark.parametrize("case", range(len(REFUSALS)))
def test_refused_in_one_line(case):
    call, line = REFUSALS[case]
    with pytest.raises(ValueError, match=f"^{line}") as refusal:
        call()
    assert "\n" not in str(refusal.value)

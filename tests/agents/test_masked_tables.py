"""Tabular agents among the actions that the environment allows."""

import csv

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

import envs  # noqa: F401  # registers the environments
from agents import ALGORITHMS, load_algorithm
from agents.common.algorithm import Transitions
from envs.wrappers import ActionMasks, IdleActionMasks

NAMES = [name for name, entry in ALGORITHMS.items() if entry.family == "tabular"]
ONE_STEP = ("qlearning", "sarsa", "expected_sarsa", "double_qlearning")
NEEDING_PROBABILITIES = ("expected_sarsa", "n_step_tree_backup", "off_policy_monte_carlo")
EXPLORATION = {
    "epsilon": {"exploration_initial_eps": 0.5, "exploration_decay": "constant"},
    "boltzmann": {"exploration": "boltzmann", "temperature": 0.5},
    "gaussian": {"exploration": "gaussian_noise", "noise_std": 20.0},
}
S, A = 3, 4


class Ring(gym.Env):
    """States in a ring; any action moves on by its number. What is masked must not be done."""

    observation_space = spaces.Discrete(S)
    action_space = spaces.Discrete(A)

    def __init__(self, masks, limit=7):
        self.masks, self.limit = np.asarray(masks, bool), limit
        self.s = self.steps = 0

    def action_masks(self):
        return self.masks[self.s]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = self.steps = 0
        return self.s, {}

    def step(self, action):
        assert self.masks[self.s, action], f"{action} is masked in {self.s}"
        self.steps += 1
        self.s = (self.s + int(action) + 1) % S
        return self.s, float(action), False, self.steps >= self.limit, {}


def agent_on(masks, name="qlearning", n_envs=1, limit=7, **kwargs):
    env = DummyVecEnv([lambda: Ring(masks, limit)] * n_envs)
    return load_algorithm(name)(env=env, seed=0, mask_actions=True, **kwargs)


@st.composite
def masks(draw):
    rows = st.lists(st.booleans(), min_size=A, max_size=A).filter(any)
    return np.array(draw(st.lists(rows, min_size=S, max_size=S)))


@pytest.mark.parametrize("exploration", EXPLORATION)
@pytest.mark.parametrize("name", NAMES)
def test_a_masked_action_is_never_chosen(name, exploration):
    if exploration == "gaussian" and name in NEEDING_PROBABILITIES:
        return
    if "exploration" not in load_algorithm(name).__signature__.parameters:
        return

    @settings(max_examples=15, deadline=None, derandomize=True)
    @given(masks(), st.sampled_from(["random", "first"]))
    def holds(allowed, ties):
        # Tables full of noise: what is best is mostly masked.
        agent = agent_on(
            allowed, name, 2, tie_breaking=ties, initial_q_std=5.0, **EXPLORATION[exploration]
        )
        agent.learn(60)  # the environment itself refuses
        counts = agent.policy.visit_counts.numpy().sum(axis=0)
        # Some learn from a step when it is over for a while.
        assert counts.sum() == 60 if name in ONE_STEP else 0 < counts.sum() <= 60
        assert not counts[~allowed].any()
        for deterministic in (True, False):
            obs = np.arange(S).repeat(20)
            # Met or not: here all are told.
            told = agent.predict(obs, deterministic=deterministic, action_masks=allowed[obs])[0]
            assert allowed[obs, told].all()
        if exploration != "gaussian":
            met = agent.policy.masks.any(axis=1)
            probabilities = agent.action_probabilities()
            assert not probabilities[met][~allowed[met]].any()
            np.testing.assert_allclose(probabilities.sum(axis=1), 1)

    holds()


# Values of the next state: the best one, action 3, is masked, and so is action 0.
NEXT_VALUES = [10.0, 4.0, 2.0, 50.0]
OTHER_VALUES = [0.0, -7.0, 8.0, 90.0]
NEXT_MASK = [False, True, True, False]


def target_of(name, **kwargs):
    """What one update moved the entry of state 0, action 1 to, with step size 1 and gamma 0.5."""
    allowed = [[True] * A, NEXT_MASK, [True] * A]
    agent = agent_on(allowed, name, learning_rate=1.0, gamma=0.5, **kwargs)
    agent._setup_learn(1)
    for table, values in zip(
        agent.policy.q_tables.numpy(), (NEXT_VALUES, OTHER_VALUES), strict=False
    ):
        table[1] = values
    agent.policy.note_masks(np.arange(S), np.array(allowed))
    agent.masks_are_known = True
    zeros = np.zeros(1, dtype=np.int64)
    no, reward = np.array([False]), np.array([3.0])
    agent._learn_from(Transitions(zeros, zeros + 1, reward, no, no, zeros + 1))
    tables = agent.policy.q_tables.numpy()[:, 0, 1]
    return tables[tables != 0], agent


def test_qlearning_bootstraps_from_the_best_allowed_action():
    assert target_of("qlearning")[0] == [3 + 0.5 * 4]


def test_expected_sarsa_bootstraps_from_the_mean_over_allowed_actions():
    constant = {"exploration_decay": "constant", "exploration_initial_eps": 0.5}
    # Half of the time a random one of two, of mean 3, else the better, 4.
    assert target_of("expected_sarsa", **constant)[0] == [3 + 0.5 * 3.5]


def test_expected_sarsa_with_softmax():
    found, _ = target_of("expected_sarsa", exploration="boltzmann", temperature=2.0)
    weight = 1 / (1 + np.exp(-1.0))
    assert found == pytest.approx([3 + 0.5 * (4 * weight + 2 * (1 - weight))], abs=1e-12)


def test_sarsa_bootstraps_from_the_allowed_action_that_it_commits_to():
    constant = {"exploration_decay": "constant", "exploration_initial_eps": 1.0}
    found, agent = target_of("sarsa", **constant)
    assert found == [3 + 0.5 * NEXT_VALUES[agent._next_actions[0]]]
    assert NEXT_MASK[agent._next_actions[0]]


def test_double_qlearning_asks_the_other_table_for_the_best_allowed_action():
    found, agent = target_of("double_qlearning")
    updated_first = agent.policy.visit_counts[0, 0, 1] == 1
    # Of the allowed, the first table prefers action 1 and the second action 2.
    assert found == [3 + 0.5 * (-7.0 if updated_first else 2.0)]


def test_where_nothing_is_known_everything_counts():
    _, agent = target_of("qlearning")
    agent.policy.masks[1] = False
    assert agent.predict(1, deterministic=True)[0] == 3
    assert agent.predict(1, deterministic=True, action_masks=NEXT_MASK)[0] == 1
    assert not agent.policy.masks[1].any(), "what is told to predict is not kept"


def test_the_last_state_of_an_episode_that_is_cut_off_is_told_by_info():
    """After two steps of 1 the episode is cut off in state 2, in which nothing is ever done."""
    allowed = [[True, False, False, False], [True, False, False, False], [False, True, True, True]]

    def learnt(wrap):
        env = DummyVecEnv([lambda: wrap(Ring(allowed, limit=2))])
        agent = load_algorithm("qlearning")(env=env, seed=0, mask_actions=True)
        return agent.learn(10).policy.masks

    assert learnt(ActionMasks).tolist() == allowed
    assert learnt(lambda env: env).tolist() == [*allowed[:2], [False] * A]


def test_without_masks_the_setting_changes_nothing():
    tables = []
    for mask_actions in (False, True):
        env = DummyVecEnv([lambda: Ring(np.ones((S, A), bool))])
        agent = load_algorithm("sarsa")(env=env, seed=0, mask_actions=mask_actions).learn(500)
        tables.append(agent.policy.q_tables.numpy().tobytes())
    assert tables[0] == tables[1]


ENGINES = ("interpreted", "compiled")
WORLDS = {
    "Warehouse": ("Warehouse-v0", {"max_episode_steps": 60}, None),
    "MineMaze": ("MineMaze-v0", {"slip": 0.2, "random_start": True}, None),
    "Taxi": ("Taxi-v4", {}, None),
    "told Taxi": ("Taxi-v4", {}, ActionMasks),
    "FrozenLake": ("FrozenLake-v1", {"is_slippery": False}, IdleActionMasks),
    "tiny": ("Warehouse-v0", {"desc": ["S.", "#G"], "max_episode_steps": 5}, None),
}
# Those that learn a model or go by bonuses are in test_learnt_models and test_optimism.
ELSEWHERE = {"dyna_q", "dyna_q_plus", "prioritized_sweeping", "r_max", "qlearning_ucb"}
COMPILED = [name for name in NAMES if name not in ELSEWHERE]
CASES = [
    (world, COMPILED[i % len(COMPILED)], list(EXPLORATION)[i % 2], 1 + 2 * (i % 2))
    for i, world in enumerate([*WORLDS, *WORLDS])
]
CASES.append(("Warehouse", "qlearning", "gaussian", 1))


@pytest.mark.parametrize(("world", "name", "exploration", "n_envs"), CASES)
def test_both_engines_end_in_the_same_bits(world, name, exploration, n_envs, tmp_path):
    env_id, env_kwargs, wrapper = WORLDS[world]
    ends = []
    for engine in ENGINES:
        folder = tmp_path / engine
        env = make_vec_env(
            env_id,
            n_envs,
            seed=3,
            env_kwargs=env_kwargs,
            wrapper_class=wrapper,
            monitor_dir=str(folder),
        )
        agent = load_algorithm(name)(
            env=env, seed=1, engine=engine, mask_actions=True, **EXPLORATION[exploration]
        )
        agent.learn(3000)
        assert agent.engine_in_use.startswith(engine)
        env.close()
        rows = [
            [row[:2] for row in csv.reader(path.read_text().splitlines()[2:])]
            for path in sorted(folder.glob("*.csv"))
        ]
        ends.append(
            {
                "rows": rows,
                "tables": agent.policy.q_tables.numpy().tobytes(),
                "visits": agent.policy.visit_counts.numpy().tobytes(),
                "masks": agent.policy.masks.tobytes(),
                "rng": agent.rng.bit_generator.state,
                "envs": [one.unwrapped.np_random.bit_generator.state for one in env.envs],
                "obs": agent._last_obs.tolist(),
                "next": agent._next_actions.tolist(),
            }
        )
        masked = ~agent.policy.masks & agent.policy.masks.any(axis=1, keepdims=True)
        assert not agent.policy.visit_counts.numpy()[:, masked].any()
    assert ends[0] == ends[1]


def test_a_zip_brings_the_masks_back(tmp_path):
    env = make_vec_env("Taxi-v4", seed=0)
    agent = load_algorithm("qlearning")(env=env, seed=0, mask_actions=True).learn(2000)
    agent.save(tmp_path / "agent")
    loaded = load_algorithm("qlearning").load(tmp_path / "agent")
    np.testing.assert_array_equal(loaded.policy.masks, agent.policy.masks)
    chosen = loaded.predict(np.arange(500), deterministic=True)[0]
    assert agent.policy.masks[np.arange(500), chosen].all()
    np.testing.assert_array_equal(agent.predict(np.arange(500), deterministic=True)[0], chosen)
    loaded.set_env(env)
    assert loaded.learn(100).mask_actions


def test_a_zip_without_masks_says_nothing_of_them(tmp_path):
    agent = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0)
    assert set(agent.policy.state_dict()) == {"q_tables", "visit_counts"}


def test_an_agent_can_begin_to_go_by_masks_and_cease_to(tmp_path):
    QLearning, env = load_algorithm("qlearning"), make_vec_env("Taxi-v4", seed=0)  # noqa: N806
    QLearning(env=env, seed=0).learn(500).save(tmp_path / "plain")
    masked = QLearning.load(tmp_path / "plain", env=env, mask_actions=True)
    assert not masked.policy.masks.any()
    assert masked.learn(500).policy.masks.any()
    masked.save(tmp_path / "masked")
    plain = QLearning.load(tmp_path / "masked", env=env, mask_actions=False)
    assert set(plain.policy.state_dict()) == {"q_tables", "visit_counts"}
    assert plain.learn(100).engine_in_use == "compiled"


BAD_MASKS = {
    "nothing": (np.zeros(A), "the action mask for observation 1 allows no action"),
    "shape": (
        np.ones(A + 1),
        r"the action mask for observation 1 has shape \(5,\), it must be \(4,\), a bool for .*",
    ),
}


@pytest.mark.parametrize("case", BAD_MASKS)
def test_malformed_masks(case):
    bad, message = BAD_MASKS[case]
    agent = agent_on(np.ones((S, A)))
    ring = agent.env.envs[0]
    ring.action_masks = lambda: bad if ring.s == 1 else np.ones(A)
    with pytest.raises(ValueError, match=f"^{message}$"):
        agent.learn(100)


def test_masks_that_do_not_depend_on_the_observation_alone():
    agent = agent_on(np.ones((S, A)))
    ring = agent.env.envs[0]
    ring.action_masks = lambda: np.arange(A) != ring.steps % A
    with pytest.raises(ValueError, match=r"^observation \d comes with different action masks"):
        agent.learn(100)


def test_an_environment_without_masks():
    message = r"^mask_actions: the environment has no method action_masks\(\); where its info"
    with pytest.raises(ValueError, match=message):
        load_algorithm("sarsa")(env="FrozenLake-v1", mask_actions=True)
    agent = agent_on(np.ones((S, A)))
    agent.env = DummyVecEnv([lambda: gym.make("FrozenLake-v1")])
    with pytest.raises(ValueError, match=message):
        agent.learn(10)


def test_the_compiled_engine_needs_the_masks_of_all_states():
    with pytest.raises(ValueError, match=r"the action masks are not known of all states$"):
        agent_on(np.ones((S, A)), engine="compiled").learn(10)

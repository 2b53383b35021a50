"""Bandit agents among the arms that the environment allows."""

import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import envs  # noqa: F401  # registers the bandits
from agents import ALGORITHMS, load_algorithm
from agents.bandits.algorithm import Pull
from agents.bandits.runs import run_batch, run_one_by_one
from agents.bandits.upper_bounds import kl_ucb_index
from agents.compiled.worlds import NotCompilable
from envs.bandits import SegmentBandit

NAMES = [name for name, entry in ALGORITHMS.items() if entry.family == "bandits"]
TABLES = [name for name in NAMES if "Box" not in ALGORITHMS[name].observations]
LINEAR = [name for name in NAMES if name not in TABLES]
C, A = 3, 4
BY_CONTEXT = np.array([[1, 0, 1, 1], [0, 1, 1, 0], [0, 0, 0, 1]], bool)


class Shop(gym.Env):
    """Customers of three segments; rewards are coins, and come in after every ``batch`` pulls.

    Args:
        masks: what is on sale, by segment and, cyclically, by the day; shape (days, C, A).
        vectors: whether segments are shown as vectors.
    """

    action_space = spaces.Discrete(A)

    def __init__(self, masks=BY_CONTEXT, batch=1, vectors=False):
        self.masks = np.reshape(masks, (-1, C, A))
        self.batch = batch
        self.vectors = vectors
        self.observation_space = spaces.Box(0, 1, (C,)) if vectors else spaces.Discrete(C)
        self.day = self.context = 0

    def action_masks(self):
        return self.masks[self.day % len(self.masks), self.context]

    def _observation(self):
        self.context = int(self.np_random.integers(C))
        return np.eye(C, dtype=np.float32)[self.context] if self.vectors else self.context

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.day = 0
        return self._observation(), {}

    def step(self, action):
        assert self.action_masks()[action], f"{action} is sold out in {self.context}"
        self.day += 1
        reward = float(self.np_random.random() < 0.2 * (1 + action))
        due = self.day % self.batch == 0
        return self._observation(), reward, False, False, {"feedback_due": due}


def agent_on(name, masks=BY_CONTEXT, n_envs=1, batch=1, vectors=False, **kwargs):
    env = DummyVecEnv([lambda: Shop(masks, batch, vectors)] * n_envs)
    return load_algorithm(name)(env=env, **{"seed": 0, "mask_actions": True, **kwargs})


def knowing(name, scores, counts=(1,) * A, **kwargs):
    """An agent with these scores, taken for average rewards, in context 0."""
    model = agent_on(name, **kwargs)
    tables = model.policy.tables
    tables.scores[0], tables.counts[0] = scores, counts
    tables.sums[0] = np.where(tables.counts[0], tables.scores[0], 0) * tables.counts[0]
    return model


def shares(model, mask, n=20_000, context=0):
    """How often an exploring agent pulls each arm."""
    contexts = model._contexts(np.full(n, context))
    rows = np.tile(np.array(mask, bool), (n, 1))
    arms, _ = model._choose(contexts, np.random.default_rng(0), rows)
    return np.bincount(arms, minlength=A) / n


def softmax(values):
    weights = np.exp(np.array(values) - max(values))
    return weights / weights.sum()


@st.composite
def masks_of_two_days(draw):
    row = st.lists(st.booleans(), min_size=A, max_size=A).filter(any)
    return np.array(draw(st.lists(row, min_size=2 * C, max_size=2 * C)))


@pytest.mark.parametrize("name", NAMES)
def test_a_masked_arm_is_never_pulled(name):
    @settings(max_examples=8, deadline=None, derandomize=True)
    @given(masks_of_two_days(), st.sampled_from(["random", "first"]), st.integers(1, 3))
    def holds(masks, ties, batch):
        model = agent_on(name, masks, 2, batch, tie_breaking=ties).learn(60)  # the shop refuses
        assert model._n_updates == sum(60 // 2 // batch * batch for _ in range(2))
        contexts = np.arange(C).repeat(10)
        for told in (masks[contexts], None):
            allowed = model.policy.kept_masks(contexts) if told is None else told
            for deterministic in (True, False):
                arms, _ = model.predict(contexts, None, None, deterministic, told)
                assert allowed[np.arange(len(arms)), arms].all()

    holds()


@pytest.mark.parametrize("name", NAMES)
def test_where_all_arms_are_allowed_masks_change_no_bit(name):
    ends = []
    for mask_actions in (False, True):
        model = agent_on(name, np.ones((C, A), bool), 2, 5, mask_actions=mask_actions).learn(400)
        tables = {key: value.numpy().tobytes() for key, value in model.policy.state_dict().items()}
        tables.pop("allowed_actions", None)
        ends.append((tables, model.rng.bit_generator.state, model._last_obs.tolist()))
    assert ends[0] == ends[1]


def test_greedy_among_the_allowed_and_ties_too():
    model = knowing("epsilon_greedy", [9, 3, 3, 1], exploration_initial_eps=0.0)
    assert shares(model, [0, 1, 1, 1]) == pytest.approx([0, 0.5, 0.5, 0], abs=0.015)
    assert shares(model, [0, 0, 1, 1]).tolist() == [0, 0, 1, 0]
    first = knowing("epsilon_greedy", [9, 3, 3, 1], exploration_initial_eps=0, tie_breaking="first")
    assert shares(first, [0, 1, 1, 1]).tolist() == [0, 1, 0, 0]


def test_epsilon_is_shared_among_the_allowed():
    model = knowing("epsilon_greedy", [9, 3, 2, 1], exploration_initial_eps=0.3)
    assert shares(model, [0, 1, 1, 1]) == pytest.approx([0, 0.8, 0.1, 0.1], abs=0.015)


@pytest.mark.parametrize("name", ["boltzmann", "gradient_bandit"])
def test_softmax_among_the_allowed(name):
    kwargs = {"temperature": 1.0} if name == "boltzmann" else {}
    model = knowing(name, [9.0, 0.5, 7.0, 1.5], **kwargs)
    few, many = softmax([0.5, 1.5])
    assert shares(model, [0, 1, 0, 1]) == pytest.approx([0, few, 0, many], abs=0.015)


def test_a_bound_counts_all_pulls_of_the_context():
    """Source: the awake upper estimated rewards of Kleinberg, Niculescu-Mizil and Sharma, 2010."""
    means, counts = np.array([0.6, 0.3, 0.9, 0.0]), np.array([50, 20, 9000, 1000])

    def bounds(pulls):
        return means[:2] + np.sqrt(2 * math.log(pulls) / counts[:2])

    # After the 70 pulls of the allowed arms alone it would be the first.
    assert bounds(70).argmax() == 0
    assert bounds(10_070).argmax() == 1
    assert shares(knowing("ucb", means, counts), [1, 1, 0, 0], 10).tolist() == [0, 1, 0, 0]


def test_the_divergence_of_coins_counts_all_pulls_of_the_context():
    means, counts = np.array([0.6, 0.3, 0.9, 0.0]), np.array([60, 10, 9000, 10_000])

    def bounds(pulls):
        return [kl_ucb_index(means[arm], counts[arm], pulls, 0.0) for arm in (0, 1)]

    assert np.argmax(bounds(70)) == 0
    assert np.argmax(bounds(19_070)) == 1
    assert shares(knowing("kl_ucb", means, counts), [1, 1, 0, 0], 10).tolist() == [0, 1, 0, 0]


@pytest.mark.parametrize("name", ["ucb", "kl_ucb"])
def test_an_arm_not_tried_yet_waits_until_it_is_allowed(name):
    model = knowing(name, [0.1, 0.9, -np.inf, -np.inf], [5, 5, 0, 0])
    assert shares(model, [1, 1, 0, 0], 10).tolist() == [0, 1, 0, 0]
    assert shares(model, [1, 1, 0, 1], 10).tolist() == [0, 0, 0, 1]
    # All that is allowed has the score of no arm tried.
    model.policy.masks[0] = [0, 0, 1, 1]
    assert model.predict(0, deterministic=True)[0] == 2


def test_gradient_step_among_the_arms_of_the_pull():
    model = knowing("gradient_bandit", [2.0, 0.5, -1.0, 1.0], [2, 1, 0, 1], learning_rate=0.5)
    model.policy.tables.sums[0] = [1.0, 3.0, 0.0, 4.0]
    model._learn(Pull(0, 3, 5.0, 1.0, [False, True, False, True]))
    few, many = softmax([0.5, 1.0])
    advantage = 0.5 * (5.0 - 2.0)  # the average of four rewards, two of them of a masked arm
    expected = [2.0, 0.5 - advantage * few, -1.0, 1.0 + advantage * (1 - many)]
    assert model.policy.scores[0].tolist() == pytest.approx(expected, rel=1e-14)
    assert model.policy.counts[0].tolist() == [2, 1, 0, 2]
    assert model.policy.sums[0].tolist() == [1.0, 3.0, 0.0, 9.0]


def test_exp3_weighs_by_the_probability_among_the_arms_of_the_pull():
    model = knowing("exp3", [5.0, 0.2, 9.0, 0.7], mixing=0.3)
    expected = 0.7 * softmax([5.0, 0.2, 0.7]) + 0.1
    mask = np.array([[True, True, False, True]])
    assert shares(model, mask[0])[[0, 1, 3]] == pytest.approx(expected, abs=0.015)
    arms, probabilities = model._choose(np.zeros(50, int), model.rng, mask.repeat(50, 0))
    assert len(set(arms)) == 3
    assert probabilities == pytest.approx(expected[np.minimum(arms, 2)], rel=1e-14)
    model._learn(Pull(0, 3, 0.5, 0.25, mask[0].tolist()))
    # exp(gamma / K * reward / probability), with three arms.
    moved = [5.0, 0.2, 9.0, 0.7 + 0.3 / 3 * 0.5 / 0.25]
    assert model.policy.scores[0].tolist() == pytest.approx(moved, rel=1e-14)


def test_thompson_draws_for_the_allowed_alone():
    model = agent_on("thompson")
    tables = model.policy.tables
    tables.sums[0], tables.counts[0] = [90, 2, 0, 1], [90, 3, 1, 1]
    draws = np.random.default_rng(5).beta([3, 1, 2], [2, 2, 1], size=(200_000, 3))
    expected = np.bincount(draws.argmax(axis=1)) / 200_000
    assert shares(model, [0, 1, 1, 1])[1:] == pytest.approx(expected, abs=0.015)
    rng, other = np.random.default_rng(1), np.random.default_rng(1)
    model._choose(np.zeros(1, int), rng, np.array([[False, True, False, True]]))
    other.beta(3, 2), other.beta(2, 1)
    assert rng.random() == other.random()


@pytest.mark.parametrize("name", ["epsilon_greedy", "ucb", "thompson"])
def test_an_update_is_that_of_the_arm_pulled(name):
    with_mask, without = agent_on(name), agent_on(name)
    for arm, reward in ((1, 1.0), (3, 0.0), (1, 0.0)):
        with_mask._learn(Pull(2, arm, reward, 1.0, [False, True, False, True]))
        without._learn(Pull(2, arm, reward, 1.0))
    for ours, theirs in zip(with_mask.policy.tables, without.policy.tables, strict=True):
        assert np.array_equal(ours, theirs)


@pytest.mark.parametrize("vectors", [False, True])
def test_linear_models_among_the_allowed(vectors):
    kwargs = {"vectors": vectors, "exploration_initial_eps": 0.3}
    greedy, ucb = agent_on("lin_epsilon_greedy", **kwargs), agent_on("linucb", vectors=vectors)
    for model in (greedy, ucb):
        for arm, reward in ((0, 9.0), (1, 3.0), (1, 3.0), (1, 3.0), (2, 3.0), (3, 1.0)):
            model._learn(Pull([0.0, 1.0, 0.0], arm, reward, 1.0))
    # Predictions are 4.5, 9/4, 3/2 and 1/2; deviations 1/sqrt(2), 1/2, 1/sqrt(2), 1/sqrt(2).
    n, context = 20_000, np.array([[0.0, 1.0, 0.0]])
    mask = np.array([[False, True, True, True]])
    contexts, masks = context.repeat(n, 0), mask.repeat(n, 0)
    arms, _ = greedy._choose(contexts, np.random.default_rng(0), masks)
    assert np.bincount(arms, minlength=A) / n == pytest.approx([0, 0.8, 0.1, 0.1], abs=0.015)
    assert ucb._choose(context, ucb.rng, mask)[0] == [1]
    # 3/2 + 5/sqrt(2) is more than 9/4 + 5/2.
    ucb.alpha = 5.0
    assert ucb._choose(context, ucb.rng, mask)[0] == [2]


def test_linear_thompson_among_the_allowed():
    model = agent_on("lin_thompson", alpha=2.0)
    for arm, reward in ((0, 99.0), (1, 3.0), (1, 3.0), (1, 3.0), (2, 3.0)):
        model._learn(Pull([1.0, 0.0, 0.0], arm, reward, 1.0))
    z = np.random.default_rng(5).standard_normal((200_000, 2)) * 2 * [0.5, math.sqrt(0.5)]
    expected = np.mean(9 / 4 + z[:, 0] > 3 / 2 + z[:, 1])
    wanted = [0, expected, 1 - expected, 0]
    assert shares(model, [0, 1, 1, 0]) == pytest.approx(wanted, abs=0.015)


def test_late_feedback_remembers_what_was_allowed():
    """Two days of other masks, and feedback on the second; nothing was learnt before."""
    days = [[[True, True, False, False]] * C, [[True] * A] * C]
    model, learnt = agent_on("exp3", days, batch=2), []
    model._learn = learnt.append
    model.learn(2)
    assert [pull.mask for pull in learnt] == [days[0][0], days[1][0]]
    assert [pull.probability for pull in learnt] == pytest.approx([1 / 2, 1 / 4], rel=1e-15)


def test_each_environment_has_masks_of_its_own():
    model, learnt = agent_on("exp3", n_envs=2), []
    model._learn = learnt.append
    model.learn(40)
    assert [pull.mask for pull in learnt] == [BY_CONTEXT[pull.context].tolist() for pull in learnt]


@pytest.mark.parametrize("name", ["epsilon_greedy", "linucb"])
def test_predict_goes_by_what_it_is_told_or_what_was_allowed_last(name):
    model = agent_on(name).learn(200)
    assert np.array_equal(model.policy.masks, BY_CONTEXT)
    contexts = np.arange(C)
    told = ~BY_CONTEXT
    for deterministic in (True, False):
        arms, state = model.predict(contexts, deterministic=deterministic)
        assert state is None
        assert BY_CONTEXT[contexts, arms].all()
        arms, _ = model.predict(contexts, deterministic=deterministic, action_masks=told)
        assert told[contexts, arms].all()
        one = model.predict(1, deterministic=deterministic, action_masks=told[1])[0]
        assert one.shape == ()
        assert told[1, one]
    assert np.array_equal(model.policy.masks, BY_CONTEXT), "what predict is told is not kept"
    model.policy.masks[1] = False  # never met: everything counts
    best = model.policy.judged(contexts)[1].argmax()
    assert model.predict(1, deterministic=True)[0] == best


def test_predict_refuses_in_one_line():
    model = agent_on("ucb")
    vectors = agent_on("linucb", vectors=True)
    for call, message in (
        (lambda: model.predict(3, deterministic=True), r"context 3 is not in Discrete\(3\)"),
        (
            lambda: model.predict([0, 1], action_masks=BY_CONTEXT),
            r"action_masks must be of shape \(2, 4\), not \(3, 4\)",
        ),
        (
            lambda: model.predict(2, action_masks=[True] * 3),
            r"the action mask for observation 2 has shape \(3,\), it must be \(4,\), a bool .*",
        ),
        (
            lambda: vectors.predict(np.eye(C)[0], deterministic=True),
            "mask_actions: predict needs action_masks where contexts are vectors",
        ),
        (
            lambda: agent_on("ucb", mask_actions=False).predict(0, action_masks=[True] * A),
            "action_masks: the agent was made without mask_actions",
        ),
    ):
        with pytest.raises(ValueError, match=f"^{message}$"):
            call()
    told = vectors.predict(np.eye(C)[0], deterministic=True, action_masks=[0, 0, 1, 1])[0]
    assert told == 2


@pytest.mark.parametrize("name", NAMES)
def test_a_zip_brings_the_masks_back(name, tmp_path):
    model = agent_on(name, batch=3).learn(200)
    model.save(tmp_path / "agent")
    loaded = load_algorithm(name).load(tmp_path / "agent")
    assert loaded.mask_actions
    assert np.array_equal(loaded.policy.masks, BY_CONTEXT)
    for agent in (model, loaded):
        agent.set_env(DummyVecEnv([Shop]))
        agent.env.seed(3)
        agent.learn(100, reset_num_timesteps=False)
    for key, value in model.policy.state_dict().items():
        assert np.array_equal(value, loaded.policy.state_dict()[key]), key


def test_an_agent_can_begin_to_go_by_masks_and_cease_to(tmp_path):
    UCB, everything = load_algorithm("ucb"), np.ones((C, A), bool)  # noqa: N806
    agent_on("ucb", everything, mask_actions=False).learn(50).save(tmp_path / "plain")
    env = DummyVecEnv([Shop])
    masked = UCB.load(tmp_path / "plain", env=env, mask_actions=True)
    assert not masked.policy.masks.any()
    masked.learn(100).save(tmp_path / "masked")
    env = DummyVecEnv([lambda: Shop(everything)])
    plain = UCB.load(tmp_path / "masked", env=env, mask_actions=False).learn(50)
    assert set(plain.policy.state_dict()) == {"scores", "sums", "counts"}


class SoldOut(SegmentBandit):
    """Arms that are sold out for a segment of our own bandit."""

    masks = np.array([[True, False, True], [True, True, False]])

    def action_masks(self):
        return self.masks[self.context]


class ToldByInfo(SegmentBandit):
    def reset(self, **kwargs):
        obs, info = super().reset(**kwargs)
        return obs, {**info, "action_mask": SoldOut.masks[obs].copy()}

    def step(self, action):
        obs, *rest, info = super().step(action)
        return obs, *rest, {**info, "action_mask": SoldOut.masks[obs].copy()}


@pytest.fixture
def sold_out():
    for kind in (SoldOut, ToldByInfo):
        gym.register(f"{kind.__name__}-v0", kind, max_episode_steps=200)
    yield
    for kind in (SoldOut, ToldByInfo):
        gym.registry.pop(f"{kind.__name__}-v0")


@pytest.mark.usefixtures("sold_out")
@pytest.mark.parametrize("name", ["ucb", "linucb"])
def test_a_batch_of_masked_runs_goes_one_by_one(name):
    kwargs = {"mask_actions": True}
    with pytest.raises(NotCompilable, match="there is no compiled copy of SoldOut"):
        run_batch(name, kwargs, "SoldOut-v0", {}, [0])
    told, by_info = (
        run_one_by_one(name, kwargs, f"{env_id}-v0", {}, [0, 5], 150)
        for env_id in ("SoldOut", "ToldByInfo")
    )
    for result in (told, by_info):
        assert SoldOut.masks[result.contexts, result.arms].all()
    assert np.array_equal(told.arms, by_info.arms)
    unmasked = run_one_by_one(name, {}, "SoldOut-v0", {}, [0], 150)
    assert not SoldOut.masks[unmasked.contexts, unmasked.arms].all()
    model = load_algorithm(name)(env=gym.make("SoldOut-v0"), seed=5, **kwargs).learn(150)
    judged = model.policy.judged(np.arange(2))
    assert np.array_equal(told.estimates[1], judged)


def test_the_compiled_batch_refuses_masks_on_our_own_bandits_too(monkeypatch):
    args = ("ucb", {"mask_actions": True}, "SegmentBandit-v0", {}, [0])
    monkeypatch.setattr(SegmentBandit, "action_masks", SoldOut.action_masks, raising=False)
    monkeypatch.setattr(SegmentBandit, "masks", SoldOut.masks, raising=False)
    message = "^the environment is asked for its action masks at each pull$"
    with pytest.raises(NotCompilable, match=message):
        run_batch(*args)
    result = run_one_by_one(*args, 50)
    assert SoldOut.masks[result.contexts, result.arms].all()


class OwnChoice(load_algorithm("ucb")):
    """Chooses in Python, among all arms."""

    def _choose(self, contexts, rng):
        return super()._choose(contexts, rng)


@pytest.mark.parametrize("name", NAMES)
def test_an_environment_without_masks(name):
    message = r"^mask_actions: the environment has no method action_masks\(\); where its info"
    with pytest.raises(ValueError, match=message):
        load_algorithm(name)(env="SegmentBandit-v0", mask_actions=True)
    model = agent_on(name)
    model.env = DummyVecEnv([lambda: gym.make("SegmentBandit-v0")])
    with pytest.raises(ValueError, match=message):
        model.learn(10)


def test_agents_that_choose_among_all_arms():
    with pytest.raises(ValueError, match=r"^mask_actions: OwnChoice chooses among all arms$"):
        OwnChoice(env=Shop(), mask_actions=True)
    MABWiserUCB1 = load_algorithm("mabwiser_ucb1")  # noqa: N806
    with pytest.raises(TypeError, match=r"^MABWiserUCB1 has no argument 'mask_actions'$"):
        MABWiserUCB1(env=Shop(), mask_actions=True)


def test_malformed_masks():
    for bad, message in (
        (np.zeros(A), "allows no action"),
        (np.ones(A + 1), r"has shape \(5,\), it must be \(4,\), a bool for each action"),
    ):
        model = agent_on("ucb")
        model.env.envs[0].action_masks = lambda bad=bad: bad
        with pytest.raises(ValueError, match=rf"^the action mask for observation \d {message}$"):
            model.learn(10)


def test_masks_behind_a_vector_wrapper():
    env = VecNormalize(DummyVecEnv([lambda: Shop(vectors=True)]))
    load_algorithm("linucb")(env=env, seed=0, mask_actions=True).learn(100)

"""The bandits: their draws one by one, what is known of them exactly, and logs of their pulls."""

import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.seeding import np_random

from rl_yardstick.envs import bandits
from rl_yardstick.envs import known_models as known
from rl_yardstick.envs.wrappers import ScaleReward
from rl_yardstick.mdp import baseline_return, finite_horizon_optimum, policy_return
from rl_yardstick.pipeline.settings import read_yaml

LOG = Path(__file__).parent / "uniform_log.csv"


def arms_to_pull(n, n_arms):
    return np.random.default_rng(99).integers(n_arms, size=n).tolist()


@pytest.mark.parametrize("drift_std", [0.0, 0.25])
@pytest.mark.parametrize("given_means", [None, [0.5, 0.5, 0.5]], ids=["redrawn", "given"])
def test_draws_of_gaussian_bandits(given_means, drift_std):
    drawn = {"n_arms": 3, "mean_loc": 2.5} if given_means is None else {"means": given_means}
    env = bandits.GaussianBandit(**drawn, reward_std=0.7, drift_std=drift_std)
    rng, _ = np_random(11)
    env.reset(seed=11)
    for _ in range(2):
        means = given_means or [2.5 + rng.standard_normal() for _ in range(3)]
        assert env.means.tolist() == [means]
        for arm in arms_to_pull(100, 3):
            _, reward, _, _, info = env.step(arm)
            assert reward == means[arm] + 0.7 * rng.standard_normal()
            assert info["expected_reward"] == means[arm]
            assert info["regret"] == max(means) - means[arm]
            if drift_std:
                means = [mean + drift_std * rng.standard_normal() for mean in means]
            assert env.means.tolist() == [means]
        env.reset()


def draw_context(rng):
    return [float(np.float32(2.0 * rng.random() - 1.0)) for _ in range(9)]


@pytest.mark.parametrize("redraws", [True, False])
def test_draws_of_linear_bandits(redraws):
    weights = np.random.default_rng(5).standard_normal((4, 9)).tolist()
    arms = {"n_arms": 4, "n_features": 9} if redraws else {"arm_parameters": weights}
    env = bandits.LinearBandit(**arms, reward_std=0.5)
    rng, _ = np_random(13)
    shown, _ = env.reset(seed=13)
    for _ in range(2):
        if redraws:
            scale = math.sqrt(3 / 9)
            weights = [[rng.standard_normal() * scale for _ in range(9)] for _ in range(4)]
        assert env.arm_parameters.tolist() == weights
        for arm in arms_to_pull(100, 4):
            context = draw_context(rng)
            assert shown.tolist() == context
            # Summed from the first to the last.
            expected = np.cumsum(np.multiply(weights, context), axis=1)[:, -1].tolist()
            shown, reward, _, _, info = env.step(arm)
            assert reward == expected[arm] + 0.5 * rng.standard_normal()
            assert info["expected_reward"] == expected[arm]
            assert info["regret"] == max(expected) - expected[arm]
            assert info["optimal_action"] == expected.index(max(expected))
        draw_context(rng)
        shown, _ = env.reset()


def test_each_of_several_best_arms_has_no_regret():
    env = bandits.BernoulliBandit([0.1, 0.7, 0.7])
    assert env.reset(seed=0)[1] == {}
    for arm, expected, regret in ((0, 0.1, 0.7 - 0.1), (1, 0.7, 0.0), (2, 0.7, 0.0)):
        info = env.step(arm)[4]
        assert (info["optimal_action"], info["expected_reward"]) == (1, expected)
        assert info["regret"] == regret


def test_an_episode_ends_after_its_pulls():
    for kwargs, length in (({}, 1000), ({"max_episode_steps": 40, "pulls": 30}, 40)):
        env = gym.make("GaussianBandit-v0", **kwargs)
        assert known.time_limit(env) == env.spec.max_episode_steps == length
        env.reset(seed=0)
        assert [env.step(0)[2:4] for _ in range(length)][-2:] == [(False, False), (False, True)]
    assert known.time_limit(gym.make("GaussianBandit-v0", max_episode_steps=-1)) is None


def test_feedback_is_due_at_the_end_of_each_batch_and_of_the_episode():
    env = gym.make("SegmentBandit-v0", batch_size=5, pulls=12)
    for _ in range(2):
        env.reset(seed=0)
        due = [env.step(0)[4]["feedback_due"] for _ in range(12)]
        assert [i for i in range(12) if due[i]] == [4, 9, 11]


def test_what_a_pooled_test_of_segments_loses_is_exact():
    env = gym.make("SegmentBandit-v0")
    model, horizon = known.transition_model(env), known.time_limit(env)
    best = finite_horizon_optimum(model, horizon).start_value / horizon
    random = policy_return(model, np.full((2, 3), 1 / 3), horizon).expected_return / horizon
    assert baseline_return(model, horizon) / horizon == pytest.approx(0.117, abs=1e-12)
    assert best == pytest.approx(0.159, abs=1e-12)
    assert (best - random) * 10_000 == pytest.approx(653.3, abs=0.1)
    env = ScaleReward(gym.make("BernoulliBandit-v0"), 2)  # of coins
    model = known.transition_model(env)
    assert (model.n_states, model.n_outcomes, model.terminated.any()) == (1, 2, False)
    assert model.expected_reward.tolist() == [[0.4, 1.0, 1.5]]
    assert known.observations_of_states(env).tolist() == [0]
    assert known.success_outcomes(env) is None


LOGS = {  # the text, names, contexts and arms; an observation space, and the observations
    # As a spreadsheet writes it: a mark in front, commas in names, and lines without anything.
    "any order": (
        '\ufeffreward,age,arm,"income, net"\n1.5,30,2,1e3\n\n-1,40.5,0,2000\n',
        ("age", "income, net"), [[30, 1000], [40.5, 2000]], [2, 0],
        spaces.Box(np.float32([30, 1000]), np.float32([40.5, 2000])), [[30, 1000], [40.5, 2000]]),
    "numbers of contexts": (
        "segment,arm,reward\n0,0,1\n1,0,1\n2,0,1\n1,0,1\n",
        ("segment",), [[0], [1], [2], [1]], [0] * 4, spaces.Discrete(3), [0, 1, 2, 1]),
    "no context": ("arm,reward\n3,1\n", (), [[]], [3], spaces.Discrete(1), [0]),
    "words": ("arm,reward,word\n0,1,True \n1,1,NA\n", ("word",), [[1], [0]], [0, 1],
        spaces.Discrete(2), [1, 0]),
}  # fmt: skip


@pytest.mark.parametrize("name", LOGS)
def test_logs_of_any_form(name, tmp_path):
    text, names, contexts, arms, space, observations = LOGS[name]
    (tmp_path / "log.csv").write_text(text, encoding="utf-8")
    data = bandits.read_log(tmp_path / "log.csv")
    assert (data.context_names, data.contexts.tolist()) == (names, contexts)
    assert (data.arms.tolist(), data.n_arms, data.propensities) == (arms, max(arms) + 1, None)
    assert data.observation_space == space
    assert data.observations(space).tolist() == observations
    with pytest.raises(ValueError, match=r"log\.csv has .*context.*, the agent observes Multi"):
        data.observations(spaces.MultiDiscrete([2]))


MISTAKES = [
    *read_yaml(LOG.with_name("wrong.yml"))["logs"],
    ("arm,reward,x\n0,1,\xff\n".encode("latin1"), r"cannot read .*: 'utf-8' codec can't decode"),
]


@pytest.mark.parametrize(("text", "message"), MISTAKES, ids=[message for _, message in MISTAKES])
def test_mistakes_in_a_log_are_named_with_their_row(tmp_path, text, message):
    path = tmp_path / "log.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=message) as refused:
        bandits.read_log(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


UNIFORM = [  # an environment, its settings, the names of its contexts
    ("SegmentBandit-v0", {"pulls": 30}, ("context",)),
    ("LinearBandit-v0", {}, tuple(f"feature_{i}" for i in range(5))),
]


@pytest.mark.parametrize(("env_id", "kwargs", "names"), UNIFORM)
def test_a_uniform_log_holds_what_the_environment_gave(env_id, kwargs, names, tmp_path):
    path, env = tmp_path / "log.csv", gym.make(env_id, **kwargs)
    bandits.log_uniformly(gym.make(env_id, **kwargs), 100, seed=3, path=path)
    data, n_arms = bandits.read_log(path), int(env.action_space.n)
    assert data.context_names == names
    assert set(data.propensities.tolist()) == {1 / n_arms}
    shown, (context, _) = data.observations(env.observation_space), env.reset(seed=3)
    for i, arm in enumerate(np.random.default_rng([3, 1]).integers(n_arms, size=100).tolist()):
        assert (np.asarray(shown[i]).tolist(), data.arms[i]) == (np.asarray(context).tolist(), arm)
        context, reward, _, truncated, _ = env.step(arm)
        assert data.rewards[i] == reward
        if truncated:
            context, _ = env.reset()


def test_replay_by_hand(tmp_path):
    with pytest.raises(ValueError, match=r"cannot read .*missing\.csv: No such file or directory"):
        gym.make("ReplayBandit-v0", log=str(tmp_path / "missing.csv"))
    data, env = bandits.read_log(LOG), gym.make("ReplayBandit-v0", log=str(LOG))
    assert (data.source, len(data), data.categories) == (str(LOG), 7, ("casual", "core"))
    assert data.rewards.tolist() == [1, 0, 1, 1, 0, 0, 0.25]
    assert (env.observation_space, env.action_space) == (spaces.Discrete(2), spaces.Discrete(2))
    assert (known.time_limit(env), known.transition_model(env)) == (7, None)
    # Context after the step, reward, matched, matched pulls so far; the arm pulled is always 0.
    expected = [(0, 1.0, True, 1), (0, 0.0, False, 1), (1, 1.0, True, 2), (0, 0.0, False, 2)]
    expected += [(1, 0.0, False, 2), (0, 0.0, True, 3), (0, 0.25, True, 4)]
    for _ in range(2):
        assert env.reset(seed=0) == (1, {})
        for step, (context, reward, matched, matched_pulls) in enumerate(expected):
            info = {"matched": matched, "matched_pulls": matched_pulls, "feedback_due": True}
            assert env.step(0) == (context, reward, False, step == 6, info)
    with pytest.raises(ValueError, match="has 7 rows: call reset after the last"):
        env.unwrapped.step(1)


def test_logs_that_were_not_uniform_are_refused(tmp_path):
    path = tmp_path / "log.csv"
    for text, message in (
        ("arm,reward\n0,1\n", "has no column 'propensity': replay needs one, each value the"),
        ("arm,reward,propensity\n0,1,0.5\n1,1,0.4\n", "the propensity of pull 2 is 0.4, not 0.5"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            bandits.ReplayBandit(path)
    # Arms that were never pulled are known from the propensities.
    path.write_text("arm,reward,propensity\n0,1,0.2\n2,0,0.2\n")
    assert bandits.ReplayBandit(path).action_space == spaces.Discrete(5)

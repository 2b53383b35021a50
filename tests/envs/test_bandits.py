"""The dynamics of the bandits: their draws one by one, and what is known of them exactly."""

import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.toy_text.utils import categorical_sample
from gymnasium.utils.seeding import np_random
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

import envs  # noqa: F401 (registers the environments)
from envs.bandits import BernoulliBandit, GaussianBandit, LinearBandit, SegmentBandit
from envs.known_models import observations_of_states, success_outcomes, time_limit, transition_model
from envs.wrappers import ScaleReward
from mdp import baseline_return, finite_horizon_optimum, policy_return

CLASSES = {
    "BernoulliBandit-v0": (BernoulliBandit, gym.spaces.Discrete(1), "clicks"),
    "GaussianBandit-v0": (GaussianBandit, gym.spaces.Discrete(1), "gaussian"),
    "LinearBandit-v0": (LinearBandit, gym.spaces.Box(-1, 1, (5,), np.float32), "linear"),
    "SegmentBandit-v0": (SegmentBandit, gym.spaces.Discrete(2), "clicks"),
}
every_id = pytest.mark.parametrize("env_id", CLASSES)


def arms_to_pull(n, n_arms):
    return np.random.default_rng(99).integers(n_arms, size=n).tolist()


# --- draws ----------------------------------------------------------------------------------------


def replay_clicks(env, shares, rates):
    """Step a bandit beside the draws that its docstring states, and compare to the last bit."""
    rng, _ = np_random(7)
    context, _ = env.reset(seed=7)
    assert context == categorical_sample(shares, rng)
    for arm in arms_to_pull(300, len(rates[0])):
        rate = rates[context][arm]
        outcomes = [rate * share for share in shares] + [(1 - rate) * share for share in shares]
        drawn = int(categorical_sample(outcomes, rng))
        click, following = (1.0, drawn) if drawn < len(shares) else (0.0, drawn - len(shares))
        best, expected = max(rates[context]), env.step(arm)
        context = following
        assert expected[:4] == (following, click, False, False)
        assert expected[4]["expected_reward"] == rate
        assert expected[4]["regret"] == best - rate
    assert env.np_random.random() == rng.random()


@given(
    weights=st.lists(st.integers(0, 9), min_size=1, max_size=5).filter(any),
    n_arms=st.integers(2, 4),
    batch_size=st.sampled_from([1, 50]),
    data=st.data(),
)
@settings(max_examples=25)
def test_draws_of_any_segments_and_coins(weights, n_arms, batch_size, data):
    shares = [weight / sum(weights) for weight in weights]
    row = st.lists(st.floats(0, 1), min_size=n_arms, max_size=n_arms)
    rates = data.draw(st.lists(row, min_size=len(shares), max_size=len(shares)))
    replay_clicks(SegmentBandit(np.array(shares), np.array(rates), batch_size), shares, rates)
    replay_clicks(BernoulliBandit(rates[0]), [1.0], rates[:1])


@pytest.mark.parametrize("drift_std", [0.0, 0.25])
@pytest.mark.parametrize("given_means", [None, [0.5, 0.5, 0.5]], ids=["redrawn", "given"])
def test_draws_of_gaussian_bandits(given_means, drift_std):
    drawn = {"n_arms": 3, "mean_loc": 2.5} if given_means is None else {"means": given_means}
    env = GaussianBandit(**drawn, reward_std=0.7, drift_std=drift_std)
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


def draw_context(rng, n):
    return [float(np.float32(2.0 * rng.random() - 1.0)) for _ in range(n)]


def weighted_sum(weights, context):
    total = weights[0] * context[0]
    for weight, feature in zip(weights[1:], context[1:], strict=True):
        total += weight * feature
    return total


@pytest.mark.parametrize("redraws", [True, False])
def test_draws_of_linear_bandits(redraws):
    weights = np.random.default_rng(5).standard_normal((4, 9)).tolist()
    arms = {"n_arms": 4, "n_features": 9} if redraws else {"arm_parameters": weights}
    env = LinearBandit(**arms, reward_std=0.5)
    rng, _ = np_random(13)
    shown, _ = env.reset(seed=13)
    for _ in range(2):
        if redraws:
            scale = math.sqrt(3 / 9)
            weights = [[rng.standard_normal() * scale for _ in range(9)] for _ in range(4)]
        assert env.arm_parameters.tolist() == weights
        for arm in arms_to_pull(100, 4):
            context = draw_context(rng, 9)
            assert shown.tolist() == context
            expected = [weighted_sum(row, context) for row in weights]
            shown, reward, _, _, info = env.step(arm)
            assert reward == expected[arm] + 0.5 * rng.standard_normal()
            assert info["expected_reward"] == expected[arm]
            assert info["regret"] == max(expected) - expected[arm]
            assert info["optimal_action"] == expected.index(max(expected))
        draw_context(rng, 9)
        shown, _ = env.reset()


class Fixed:
    """A generator whose next uniform number is known."""

    def __init__(self, uniform):
        self.uniform = uniform

    def random(self):
        return self.uniform


def test_uniform_numbers_on_the_edge_choose_as_toy_text_does():
    # In floating point 0.7 + 0.2 + 0.1 stays below 1.
    env = SegmentBandit([0.7, 0.2, 0.1], [[0.1, 0.3], [0.0, 1.0], [0.7, 0.2]])
    assert env.context_cumulative[-1] < 1
    model = env.transition_model()
    edges = np.concatenate([[0.0], np.cumsum(model.initial), np.cumsum(model.prob, axis=2).ravel()])
    uniforms = np.concatenate([edges, np.nextafter(edges, 0), np.nextafter(edges, 1)])
    for uniform in np.unique(uniforms[uniforms < 1]).tolist():
        env.np_random = Fixed(uniform)
        env.reset()
        assert env.context == categorical_sample(model.initial, env.np_random)
        for segment, arm in np.ndindex(3, 2):
            env.s = segment
            chosen = categorical_sample(model.prob[segment, arm], env.np_random)
            following, reward, *_ = env.step(arm)
            assert following == model.next_state[segment, arm, chosen]
            assert reward == model.reward[segment, arm, chosen]


# --- what step tells, and when it ends ------------------------------------------------------------


def test_each_of_several_best_arms_has_no_regret():
    env = BernoulliBandit([0.1, 0.7, 0.7])
    assert env.reset(seed=0)[1] == {}
    for arm, regret in ((0, 0.7 - 0.1), (1, 0.0), (2, 0.0)):
        info = env.step(arm)[4]
        assert (info["optimal_action"], info["regret"]) == (1, regret)


@every_id
def test_what_is_shown_tells_nothing_of_the_arms_and_information_is_plain(env_id):
    one, other = gym.make(env_id), gym.make(env_id)
    _, space, kind = CLASSES[env_id]
    assert (one.observation_space, one.unwrapped.kind) == (space, kind)
    one.reset(seed=4)
    other.reset(seed=4)
    for _ in range(20):
        first, second = one.step(0)[4], other.step(1)[4]
    # Rewards and contexts to come do not depend on earlier arms.
    assert one.step(1)[1] == other.step(1)[1]
    assert first is not second
    expected = {"optimal_action": int, "expected_reward": float, "regret": float}
    types = {name: type(value) for name, value in first.items()}
    assert types == {**expected, "feedback_due": bool}


LENGTHS = [
    ({}, 1000),
    ({"pulls": 7}, 7),
    ({"pulls": 2500}, 2500),
    ({"max_episode_steps": 40}, 40),
    ({"max_episode_steps": 40, "pulls": 30}, 40),
]


@pytest.mark.parametrize(("kwargs", "length"), LENGTHS, ids=str)
def test_an_episode_ends_after_its_pulls(kwargs, length):
    env = gym.make("GaussianBandit-v0", **kwargs)
    assert time_limit(env) == env.spec.max_episode_steps == length
    for _ in range(2):
        env.reset(seed=0)
        assert [env.step(0)[2:4] for _ in range(length)][-2:] == [(False, False), (False, True)]
    assert time_limit(gym.make("GaussianBandit-v0", max_episode_steps=-1)) is None


@given(batch_size=st.integers(1, 12), pulls=st.integers(1, 40))
@settings(max_examples=30)
def test_feedback_is_due_at_the_end_of_each_batch(batch_size, pulls):
    env = gym.make("SegmentBandit-v0", batch_size=batch_size, pulls=pulls)
    for _ in range(2):
        env.reset(seed=0)
        due = [env.step(0)[4]["feedback_due"] for _ in range(pulls)]
        assert due == [(i + 1) % batch_size == 0 or i == pulls - 1 for i in range(pulls)]


# --- known figures --------------------------------------------------------------------------------


def test_what_a_pooled_test_of_segments_loses_is_exact():
    env = gym.make("SegmentBandit-v0")
    model, horizon = transition_model(env), time_limit(env)
    assert baseline_return(model, horizon) / horizon == pytest.approx(0.117, abs=1e-12)
    best = finite_horizon_optimum(model, horizon).start_value / horizon
    assert best == pytest.approx(0.159, abs=1e-12)
    random = policy_return(model, np.full((2, 3), 1 / 3), horizon).expected_return / horizon
    assert (best - random) * 10_000 == pytest.approx(653.3, abs=0.1)


def test_the_model_of_coins():
    env = ScaleReward(gym.make("BernoulliBandit-v0"), 2)
    model = transition_model(env)
    assert (model.n_states, model.n_actions, model.n_outcomes) == (1, 3, 2)
    assert model.expected_reward.tolist() == [[0.4, 1.0, 1.5]]
    assert not model.terminated.any()
    assert finite_horizon_optimum(model, 1000).start_value == pytest.approx(1500)
    always_first = policy_return(model, np.array([[1.0, 0, 0]]), 1000)
    assert always_first.expected_return == pytest.approx(400)
    assert always_first.return_variance == pytest.approx(4 * 1000 * 0.2 * 0.8)
    assert observations_of_states(env).tolist() == [0]
    assert success_outcomes(env) is None


def test_the_best_possible_mean_rewards():
    best_possible, _ = integrate.quad(
        lambda x: x * 10 * stats.norm.pdf(x) * stats.norm.cdf(x) ** 9, -10, 10
    )
    assert best_possible == pytest.approx(1.5388, abs=5e-5)
    env, best = GaussianBandit(), []
    env.reset(seed=0)
    for _ in range(5000):
        env.reset()
        best.append(max(env.expected_rewards()))
    # The best of ten standard normal numbers has standard deviation 0.587.
    assert np.mean(best) == pytest.approx(best_possible, abs=4 * 0.587 / math.sqrt(5000))
    env, drawn = LinearBandit(n_arms=1000, n_features=7), []
    env.reset(seed=0)
    for _ in range(100):
        env.reset()
        drawn += env.expected_rewards()
    # Over the many arms of an episode the variance is 3 / 7 of the squared length of the features
    # that they share, and that has mean 1 and variance 0.8 / 7.
    assert np.var(drawn) == pytest.approx(1, abs=5 * math.sqrt(0.8 / 7 / 100))


# --- arguments ------------------------------------------------------------------------------------

MANY = {"segment_probabilities": [1 / 1024] * 1024, "click_rates": [[0.5, 0.5]] * 1024}
ONE = {"segment_probabilities": [1], "click_rates": [[0.5]]}
REFUSED = [
    ("Bernoulli", {"probabilities": [0.5]}, "probabilities must hold 2 numbers or more, not 1"),
    ("Bernoulli", {"probabilities": 0.5}, "probabilities must be a list of numbers, not 0.5"),
    ("Bernoulli", {"probabilities": "ab"}, "probabilities must be a list of numbers, not 'ab'"),
    (
        "Bernoulli",
        {"probabilities": [0.5, 1.5]},
        r"probabilities\[1\] must be a finite number from",
    ),
    ("Bernoulli", {"pulls": 0}, "pulls must be a whole number from 1 to 1000000000, not 0"),
    ("Gaussian", {"n_arms": 1}, "n_arms must be a whole number from 2 to 10000, not 1"),
    ("Gaussian", {"means": [1, 2], "n_arms": 3}, "n_arms is 3, but 2 are given: leave it out"),
    ("Gaussian", {"means": [1, 2], "mean_loc": 4}, "mean_loc is for means that are drawn"),
    ("Gaussian", {"means": [1, None]}, r"means\[1\] must be a finite number, not None"),
    ("Gaussian", {"reward_std": -1}, "reward_std must be a finite number"),
    ("Gaussian", {"drift_std": math.nan}, "drift_std must be a finite number"),
    ("Linear", {"arm_parameters": []}, "arm_parameters must be a list of rows of numbers"),
    ("Linear", {"arm_parameters": [[1, 2]]}, "arm_parameters must have two rows or more"),
    ("Linear", {"arm_parameters": [[1, 2], [1]]}, r"\[1\] has length 1, arm_parameters\[0\] has 2"),
    ("Linear", {"arm_parameters": [[1, 2], [3, 4]], "n_features": 3}, "n_features is 3, but 2 are"),
    ("Linear", {"n_features": 0}, "n_features must be a whole number from 1 to 10000, not 0"),
    ("Segment", {"segment_probabilities": [0.3, 0.6]}, "must sum to 1, not to 0.9"),
    ("Segment", {"segment_probabilities": [0.3, 0.3, 0.4]}, "must have a row for each segment: 3"),
    ("Segment", ONE, "click_rates must have a column for each treatment, two or more"),
    (
        "Segment",
        {"click_rates": [[0.1, 0.2], [0.3, -0.1]]},
        r"click_rates\[1\]\[1\] must be a finite",
    ),
    ("Segment", {"batch_size": 0}, "batch_size must be a whole number from 1 to"),
    ("Segment", MANY, "1024 contexts and 2 arms are too many: .* may be at most 2000000"),
]


@pytest.mark.parametrize(("name", "wrong", "message"), REFUSED, ids=[row[2] for row in REFUSED])
def test_arguments_out_of_range_are_refused(name, wrong, message):
    with pytest.raises(ValueError, match=message) as refused:
        CLASSES[f"{name}Bandit-v0"][0](**wrong)
    assert "\n" not in str(refused.value)

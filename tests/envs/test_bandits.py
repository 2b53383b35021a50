"""The dynamics of the bandits: their draws one by one, and what is known of them exactly."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.toy_text.utils import categorical_sample
from gymnasium.utils.seeding import np_random
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import integrate, stats

import envs  # noqa: F401
from envs.bandits import Bandit, BernoulliBandit, GaussianBandit, LinearBandit, SegmentBandit
from envs.bandits.clicks import ClickBandit
from envs.known_models import observations_of_states, success_outcomes, time_limit, transition_model
from envs.wrappers import ScaleReward
from mdp import baseline_return, finite_horizon_optimum, policy_return

SIMPLE_IDS = ["BernoulliBandit-v0", "GaussianBandit-v0", "LinearBandit-v0", "SegmentBandit-v0"]
every_id = pytest.mark.parametrize("env_id", SIMPLE_IDS)


def arms_to_pull(n: int, n_arms: int) -> list[int]:
    arms: list[int] = np.random.default_rng(99).integers(n_arms, size=n).tolist()
    return arms


# --- draws ----------------------------------------------------------------------------------------


def replay_clicks(env: ClickBandit, shares: list[float], rates: list[list[float]]) -> None:
    """Step a bandit beside the draws that its docstring states, and compare to the last bit."""
    rng, _ = np_random(7)
    context, _ = env.reset(seed=7)
    assert context == categorical_sample(shares, rng)
    for arm in arms_to_pull(500, len(rates[0])):
        rate = rates[context][arm]
        outcomes = [rate * share for share in shares] + [(1 - rate) * share for share in shares]
        drawn = int(categorical_sample(outcomes, rng))
        click, following = (1.0, drawn) if drawn < len(shares) else (0.0, drawn - len(shares))
        context, reward, terminated, truncated, _ = env.step(arm)
        assert (context, reward, terminated, truncated) == (following, click, False, False)
    assert env.np_random.random() == rng.random()


def test_draws_of_bernoulli_bandits() -> None:
    replay_clicks(BernoulliBandit([0.3, 0.9]), [1.0], [[0.3, 0.9]])


def test_a_coin_falls_on_heads_below_its_probability() -> None:
    env = BernoulliBandit([0.0, 0.1, 0.75, 1.0])
    rng, _ = np_random(3)
    env.reset(seed=3)
    rng.random()
    for arm in arms_to_pull(500, 4):
        assert env.step(arm)[1] == float(rng.random() < (0.0, 0.1, 0.75, 1.0)[arm])


def test_draws_of_segment_bandits() -> None:
    rates = [[0.1, 0.25, 0.05], [0.12, 0.06, 0.05]]
    replay_clicks(SegmentBandit(), [0.3, 0.7], rates)
    rates = [[0.5, 0.1], [0.2, 0.9], [1.0, 0.0]]
    replay_clicks(SegmentBandit([0.2, 0.5, 0.3], rates, batch_size=4), [0.2, 0.5, 0.3], rates)


@given(
    weights=st.lists(st.integers(0, 9), min_size=1, max_size=5).filter(any),
    n_arms=st.integers(2, 4),
    data=st.data(),
)
@settings(max_examples=25)
def test_draws_of_any_segments(weights: list[int], n_arms: int, data: st.DataObject) -> None:
    shares = [weight / sum(weights) for weight in weights]
    row = st.lists(st.floats(0, 1), min_size=n_arms, max_size=n_arms)
    rates = data.draw(st.lists(row, min_size=len(shares), max_size=len(shares)))
    replay_clicks(SegmentBandit(shares, rates), shares, rates)


def test_draws_of_means_that_are_redrawn() -> None:
    env = GaussianBandit(n_arms=4, mean_loc=2.5, reward_std=0.7)
    rng, _ = np_random(11)
    env.reset(seed=11)
    for _ in range(3):
        means = [2.5 + rng.standard_normal() for _ in range(4)]
        assert env.means.tolist() == [means]
        for arm in arms_to_pull(50, 4):
            assert env.step(arm)[1] == means[arm] + 0.7 * rng.standard_normal()
        env.reset()


def test_draws_of_means_that_drift() -> None:
    given_means = [0.5, 0.5, 0.5]
    env = GaussianBandit(given_means, drift_std=0.25)
    rng, _ = np_random(12)
    env.reset(seed=12)
    for _ in range(2):
        means = list(given_means)
        assert env.means.tolist() == [means]
        for arm in arms_to_pull(100, 3):
            _, reward, _, _, info = env.step(arm)
            assert reward == means[arm] + 1.0 * rng.standard_normal()
            assert info["expected_reward"] == means[arm]
            assert info["regret"] == max(means) - means[arm]
            means = [mean + 0.25 * rng.standard_normal() for mean in means]
            assert env.means.tolist() == [means]
        env.reset()
    assert env.np_random.random() == rng.random()


def draw_context(rng: np.random.Generator, n: int) -> list[float]:
    return [float(np.float32(2.0 * rng.random() - 1.0)) for _ in range(n)]


def weighted_sum(weights: list[float], context: list[float]) -> float:
    total = weights[0] * context[0]
    for weight, feature in zip(weights[1:], context[1:], strict=True):
        total += weight * feature
    return total


@pytest.mark.parametrize("redraws", [True, False])
def test_draws_of_linear_bandits(redraws: bool) -> None:
    n_arms, n_features = 4, 9
    fixed = np.random.default_rng(5).standard_normal((n_arms, n_features)).tolist()
    if redraws:
        env = LinearBandit(n_arms=n_arms, n_features=n_features, reward_std=0.5)
    else:
        env = LinearBandit(fixed, reward_std=0.5)
    rng, _ = np_random(13)
    shown, _ = env.reset(seed=13)
    for _ in range(2):
        scale = math.sqrt(3 / n_features)
        weights = fixed
        if redraws:
            weights = [
                [rng.standard_normal() * scale for _ in range(n_features)] for _ in range(n_arms)
            ]
        assert env.arm_parameters.tolist() == weights
        for arm in arms_to_pull(200, n_arms):
            context = draw_context(rng, n_features)
            assert shown.tolist() == context
            expected = [weighted_sum(row, context) for row in weights]
            shown, reward, _, _, info = env.step(arm)
            assert reward == expected[arm] + 0.5 * rng.standard_normal()
            assert info["expected_reward"] == expected[arm]
            assert info["regret"] == max(expected) - expected[arm]
            assert info["optimal_action"] == expected.index(max(expected))
        draw_context(rng, n_features)
        shown, _ = env.reset()


def test_expected_rewards_of_a_linear_bandit_have_variance_one() -> None:
    env = LinearBandit(n_arms=1000, n_features=7)
    env.reset(seed=0)
    drawn = []
    for _ in range(200):
        env.reset()
        drawn += env.expected_rewards()
    # Over the many arms of an episode the variance is 3 / 7 of the squared length of the features
    # that they share, and that has mean 1 and variance 0.8 / 7.
    assert np.var(drawn) == pytest.approx(1, abs=5 * math.sqrt(0.8 / 7 / 200))


# --- what step tells ------------------------------------------------------------------------------


def test_regret_of_coins_by_hand() -> None:
    env = gym.make("BernoulliBandit-v0")
    _, info = env.reset(seed=0)
    assert info == {}
    for arm, expected, regret in ((0, 0.2, 0.55), (1, 0.5, 0.25), (2, 0.75, 0.0)):
        info = env.step(arm)[4]
        assert info["optimal_action"] == 2
        assert info["expected_reward"] == expected
        assert info["regret"] == pytest.approx(regret, abs=1e-15)


def test_regret_of_segments_by_hand() -> None:
    env = SegmentBandit()
    context, _ = env.reset(seed=1)
    seen = set()
    for arm in arms_to_pull(100, 3):
        segment = context
        context, _, _, _, info = env.step(arm)
        best, rates = ((1, (0.10, 0.25, 0.05)), (0, (0.12, 0.06, 0.05)))[segment]
        assert info["optimal_action"] == best
        assert info["expected_reward"] == rates[arm]
        assert info["regret"] == rates[best] - rates[arm]
        seen.add((segment, arm))
    assert len(seen) == 6


def test_each_of_several_best_arms_has_no_regret() -> None:
    env = BernoulliBandit([0.1, 0.7, 0.7])
    env.reset(seed=0)
    for arm, regret in ((0, 0.7 - 0.1), (1, 0.0), (2, 0.0)):
        info = env.step(arm)[4]
        assert (info["optimal_action"], info["regret"]) == (1, regret)


@every_id
def test_information_is_plain_and_fresh(env_id: str) -> None:
    env = gym.make(env_id)
    env.reset(seed=0)
    first, second = env.step(0)[4], env.step(0)[4]
    assert first is not second
    types = {name: type(value) for name, value in first.items()}
    assert types == {
        "optimal_action": int,
        "expected_reward": float,
        "regret": float,
        "feedback_due": bool,
    }


@every_id
def test_what_is_observed_tells_nothing_of_the_arms(env_id: str) -> None:
    env = gym.make(env_id)
    space = env.observation_space
    expected = {
        "BernoulliBandit-v0": gym.spaces.Discrete(1),
        "GaussianBandit-v0": gym.spaces.Discrete(1),
        "LinearBandit-v0": gym.spaces.Box(-1, 1, (5,), np.float32),
        "SegmentBandit-v0": gym.spaces.Discrete(2),
    }
    assert space == expected[env_id]


@every_id
def test_reward_and_next_context_do_not_depend_on_earlier_arms(env_id: str) -> None:
    one, other = gym.make(env_id), gym.make(env_id)
    one.reset(seed=4)
    other.reset(seed=4)
    for _ in range(20):
        one.step(0)
        other.step(0)
    assert one.step(1)[1] == other.step(1)[1]


# --- length and batches ---------------------------------------------------------------------------


def episode_length(env: gym.Env[Any, Any]) -> int:
    env.reset(seed=0)
    for step in range(1, 5001):
        _, _, terminated, truncated, _ = env.step(0)
        assert not terminated
        if truncated:
            return step
    raise AssertionError("the episode does not end")


@every_id
@pytest.mark.parametrize(
    ("kwargs", "length"),
    [
        ({}, 1000),
        ({"pulls": 7}, 7),
        ({"pulls": 2500}, 2500),
        ({"max_episode_steps": 40}, 40),
        ({"max_episode_steps": 40, "pulls": 30}, 40),
    ],
)
def test_an_episode_ends_after_its_pulls(env_id: str, kwargs: dict[str, Any], length: int) -> None:
    env = gym.make(env_id, **kwargs)
    assert time_limit(env) == length
    assert episode_length(env) == length
    assert episode_length(env) == length
    assert env.spec is not None
    assert env.spec.max_episode_steps == length


def test_without_limit_an_episode_never_ends() -> None:
    env = gym.make("BernoulliBandit-v0", max_episode_steps=-1)
    assert time_limit(env) is None


@given(batch_size=st.integers(1, 12), pulls=st.integers(1, 40))
@settings(max_examples=30)
def test_feedback_is_due_at_the_end_of_each_batch(batch_size: int, pulls: int) -> None:
    env = gym.make("SegmentBandit-v0", batch_size=batch_size, pulls=pulls)
    for _ in range(2):
        env.reset(seed=0)
        due = [env.step(0)[4]["feedback_due"] for _ in range(pulls)]
        assert due == [(i + 1) % batch_size == 0 or i == pulls - 1 for i in range(pulls)]


def test_batches_leave_the_rewards_as_they_are() -> None:
    at_once, in_batches = gym.make("SegmentBandit-v0"), gym.make("SegmentBandit-v0", batch_size=50)
    assert at_once.reset(seed=9) == in_batches.reset(seed=9)
    for arm in arms_to_pull(300, 3):
        assert at_once.step(arm)[:4] == in_batches.step(arm)[:4]


# --- known figures --------------------------------------------------------------------------------


def test_what_a_pooled_test_loses_is_exact() -> None:
    env = gym.make("SegmentBandit-v0")
    model, horizon = transition_model(env), time_limit(env)
    assert model is not None
    assert horizon is not None
    assert baseline_return(model, horizon) / horizon == pytest.approx(0.117, abs=1e-12)
    assert finite_horizon_optimum(model, horizon).start_value / horizon == pytest.approx(
        0.159, abs=1e-12
    )
    random = policy_return(model, np.full((2, 3), 1 / 3), horizon).expected_return / horizon
    # Regret at 10,000 pulls of a random agent: 653.
    assert (0.159 - random) * 10_000 == pytest.approx(653.3, abs=0.1)


def test_the_model_of_coins() -> None:
    env = ScaleReward(gym.make("BernoulliBandit-v0"), 2)
    model = transition_model(env)
    assert model is not None
    assert (model.n_states, model.n_actions, model.n_outcomes) == (1, 3, 2)
    assert model.expected_reward.tolist() == [[0.4, 1.0, 1.5]]
    assert not model.terminated.any()
    assert finite_horizon_optimum(model, 1000).start_value == pytest.approx(1500)
    always_first = policy_return(model, np.array([[1.0, 0, 0]]), 1000)
    assert always_first.expected_return == pytest.approx(400)
    assert always_first.return_variance == pytest.approx(4 * 1000 * 0.2 * 0.8)
    observations = observations_of_states(env)
    assert observations is not None
    assert observations.tolist() == [0]
    assert success_outcomes(env) is None


@pytest.mark.parametrize("env_id", ["GaussianBandit-v0", "LinearBandit-v0"])
def test_where_rewards_are_not_finitely_many_there_is_no_model(env_id: str) -> None:
    env = gym.make(env_id)
    assert transition_model(env) is None
    assert observations_of_states(env) is None


def test_the_best_possible_mean_reward_of_the_testbed() -> None:
    def density(x: float) -> float:
        return x * 10 * float(stats.norm.pdf(x) * stats.norm.cdf(x) ** 9)

    best_possible, _ = integrate.quad(density, -10, 10)
    assert best_possible == pytest.approx(1.5388, abs=5e-5)
    env = GaussianBandit()
    env.reset(seed=0)
    best = []
    for _ in range(5000):
        env.reset()
        best.append(max(env.expected_rewards()))
    # The best of ten standard normal numbers has standard deviation 0.587.
    assert np.mean(best) == pytest.approx(best_possible, abs=4 * 0.587 / math.sqrt(5000))


def frequencies(env: Bandit, arm: int, n: int) -> NDArray[np.float64]:
    """How often each pair of context before and click came up."""
    counts = np.zeros((env.n_contexts, 2))
    context, _ = env.reset(seed=2)
    for _ in range(n):
        following, reward, *_ = env.step(arm)
        counts[context, int(reward)] += 1
        context = following
    return counts / n


def test_users_and_clicks_come_as_often_as_stated() -> None:
    n = 20_000
    seen = frequencies(SegmentBandit(), 0, n)
    exact = np.array([[0.3 * 0.9, 0.3 * 0.1], [0.7 * 0.88, 0.7 * 0.12]])
    assert np.all(np.abs(seen - exact) < 4 * np.sqrt(exact * (1 - exact) / n))


class Fixed:
    """A generator whose next uniform number is known."""

    def __init__(self, uniform: float) -> None:
        self.uniform = uniform

    def random(self) -> float:
        return self.uniform


def test_uniform_numbers_on_the_edge_choose_as_toy_text_does() -> None:
    # In floating point 0.7 + 0.2 + 0.1 stays below 1.
    env = SegmentBandit([0.7, 0.2, 0.1], [[0.1, 0.3], [0.0, 1.0], [0.7, 0.2]])
    assert env.context_cumulative[-1] < 1
    model = env.transition_model()
    edges = np.concatenate([[0.0], np.cumsum(model.initial), np.cumsum(model.prob, axis=2).ravel()])
    uniforms = np.concatenate([edges, np.nextafter(edges, 0), np.nextafter(edges, 1)])
    for uniform in np.unique(uniforms[uniforms < 1]).tolist():
        env._np_random = Fixed(uniform)  # type: ignore[assignment]
        env.reset()
        assert env.context == categorical_sample(model.initial, env.np_random)
        for segment, arm in np.ndindex(3, 2):
            env.s = segment
            chosen = categorical_sample(model.prob[segment, arm], env.np_random)
            following, reward, *_ = env.step(arm)
            assert following == model.next_state[segment, arm, chosen]
            assert reward == model.reward[segment, arm, chosen]


def test_the_arrays_that_compiled_copies_read() -> None:
    env = SegmentBandit()
    assert env.context_cumulative.tolist() == [0.3, 1.0]
    assert env.outcome_cumulative.shape == (2, 3, 4)
    np.testing.assert_allclose(
        env.outcome_cumulative[0, 1], np.cumsum([0.075, 0.175, 0.225, 0.525]), rtol=1e-15
    )
    assert env.means.tolist() == [[0.10, 0.25, 0.05], [0.12, 0.06, 0.05]]
    kinds = [gym.make(env_id).unwrapped.kind for env_id in SIMPLE_IDS]  # type: ignore[attr-defined]
    assert kinds == ["clicks", "gaussian", "linear", "clicks"]


# --- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "wrong", "message"),
    [
        ("Bernoulli", {"probabilities": [0.5]}, "probabilities must hold 2 numbers or more, not 1"),
        ("Bernoulli", {"probabilities": 0.5}, "probabilities must be a list of numbers, not 0.5"),
        ("Bernoulli", {"probabilities": "ab"}, "probabilities must be a list of numbers, not 'ab'"),
        (
            "Bernoulli",
            {"probabilities": [0.5, 1.5]},
            r"probabilities\[1\] must be a finite number from 0 to 1, not 1.5",
        ),
        ("Bernoulli", {"pulls": 0}, "pulls must be a whole number from 1 to 1000000000, not 0"),
        ("Bernoulli", {"render_mode": "ansy"}, "render_mode 'ansy': did you mean 'ansi'"),
        ("Gaussian", {"n_arms": 1}, "n_arms must be a whole number from 2 to 10000, not 1"),
        ("Gaussian", {"means": [1, 2], "n_arms": 3}, "n_arms is 3, but 2 are given: leave it out"),
        ("Gaussian", {"means": [1, 2], "mean_loc": 4}, "mean_loc is for means that are drawn"),
        ("Gaussian", {"means": [1, None]}, r"means\[1\] must be a finite number, not None"),
        ("Gaussian", {"reward_std": -1}, "reward_std must be a finite number"),
        ("Gaussian", {"drift_std": math.nan}, "drift_std must be a finite number"),
        ("Linear", {"arm_parameters": []}, "arm_parameters must be a list of rows of numbers"),
        ("Linear", {"arm_parameters": [[1, 2]]}, "arm_parameters must have two rows or more"),
        (
            "Linear",
            {"arm_parameters": [[1, 2], [1]]},
            r"arm_parameters\[1\] has length 1, arm_parameters\[0\] has 2",
        ),
        (
            "Linear",
            {"arm_parameters": [[1, 2], [3, 4]], "n_features": 3},
            "n_features is 3, but 2 are given: leave it out",
        ),
        ("Linear", {"n_features": 0}, "n_features must be a whole number from 1 to 10000, not 0"),
        (
            "Segment",
            {"segment_probabilities": [0.3, 0.6]},
            "segment_probabilities must sum to 1, not to 0.9",
        ),
        (
            "Segment",
            {"segment_probabilities": [0.3, 0.3, 0.4]},
            "click_rates must have a row for each segment: 3, not 2",
        ),
        (
            "Segment",
            {"segment_probabilities": [1], "click_rates": [[0.5]]},
            "click_rates must have a column for each treatment, two or more",
        ),
        (
            "Segment",
            {"click_rates": [[0.1, 0.2], [0.3, -0.1]]},
            r"click_rates\[1\]\[1\] must be a finite number from 0 to 1, not -0.1",
        ),
        ("Segment", {"batch_size": 0}, "batch_size must be a whole number from 1 to"),
        (
            "Segment",
            {"segment_probabilities": [1 / 1024] * 1024, "click_rates": [[0.5, 0.5]] * 1024},
            "1024 contexts and 2 arms are too many: .* may be at most 2000000",
        ),
    ],
)
def test_arguments_out_of_range_are_refused(
    env_id: str, wrong: dict[str, Any], message: str
) -> None:
    classes: dict[str, Any] = {
        "Bernoulli": BernoulliBandit,
        "Gaussian": GaussianBandit,
        "Linear": LinearBandit,
        "Segment": SegmentBandit,
    }
    with pytest.raises(ValueError, match=message) as refused:
        classes[env_id](**wrong)
    assert "\n" not in str(refused.value)


@every_id
@pytest.mark.parametrize("arm", [-1, 10])
def test_an_arm_that_does_not_exist_is_refused(env_id: str, arm: int) -> None:
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"arm {arm} does not exist: they are numbered 0 to"):
        env.step(arm)


def test_arrays_are_taken_for_lists() -> None:
    assert GaussianBandit(means=np.array([1.0, 2.0])).given_means == (1.0, 2.0)  # type: ignore[arg-type]
    weights = np.array([[1.0, 2.0], [3.0, 4.0]])
    assert LinearBandit(weights).arm_parameters.tolist() == weights.tolist()  # type: ignore[arg-type]

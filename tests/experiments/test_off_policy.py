"""Off-policy estimates: worked out by hand, and against click rates that are known exactly."""

import csv
from itertools import combinations

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import envs  # noqa: F401
from envs.bandits import log_uniformly, read_log
from experiments.off_policy.estimators import (
    ArmMeans,
    ArmRegressions,
    check_rewards,
    check_support,
    cross_fit,
    difference_in_value,
    direct_method,
    doubly_robust,
    effective_sample_size,
    evaluate_policy,
    importance_weights,
    ips,
    mean_reward,
    snips,
    terms_as_logged,
)
from verdicts import Estimate, paired_difference

ESTIMATORS = ("ips", "snips", "direct", "doubly_robust")
# The best treatment for each segment, at .159 clicks a user.
BY_SEGMENT = np.array([[0.0, 1, 0], [1, 0, 0]])
TRUTH = 0.3 * 0.25 + 0.7 * 0.12
# A logging policy that looks at the segment, and never rules a treatment out.
UNEVEN = np.array([[0.6, 0.2, 0.2], [0.1, 0.3, 0.6]])


# --- by hand --------------------------------------------------------------------------------------

ARMS = np.array([0, 0, 1, 1])
REWARDS = np.array([1.0, 0, 1, 3])
PROPENSITIES = np.array([0.5, 0.5, 0.25, 0.5])
ALWAYS_1 = np.array([[0.0, 1]] * 4)


@pytest.fixture
def each_by_the_others():
    """One context, and as many folds as pulls: each predicted by the mean of its arm's others."""
    return cross_fit(np.zeros(4, np.int64), ARMS, REWARDS, 2, n_folds=4)


def test_predictions_leave_out_the_pull_itself(each_by_the_others):
    expected = [[0, 2], [1, 2], [0.5, 3], [0.5, 1]]
    assert each_by_the_others.predicted == pytest.approx(np.array(expected))


def test_the_four_estimators_by_hand(each_by_the_others):
    weights = importance_weights(ALWAYS_1, ARMS, PROPENSITIES)
    assert weights.tolist() == [0, 0, 4, 2]
    assert ips(weights, REWARDS).tolist() == [0, 0, 4, 6]
    # The ratio is 10 / 6; the mean weight 1.5.
    ratio = 10 / 6
    by_hand = [ratio, ratio, ratio + 4 * (1 - ratio) / 1.5, ratio + 2 * (3 - ratio) / 1.5]
    assert snips(weights, REWARDS) == pytest.approx(np.array(by_hand))
    assert snips(weights, REWARDS).mean() == pytest.approx(ratio)
    assert direct_method(ALWAYS_1, each_by_the_others).mean() == pytest.approx((2 + 2 + 3 + 1) / 4)
    terms = doubly_robust(ALWAYS_1, weights, ARMS, REWARDS, each_by_the_others.predicted)
    assert terms == pytest.approx(np.array([2, 2, 3 + 4 * (1 - 3), 1 + 2 * (3 - 1)]))
    assert effective_sample_size(weights) == pytest.approx(36 / 20)


def test_the_interval_by_hand():
    estimate = mean_reward(np.array([1.0, 2, 3, 4]))
    # Standard deviation 1.2910, four values, t quantile 3.1824.
    assert estimate.point == 2.5
    assert estimate.high - 2.5 == pytest.approx(3.18245 * 1.29099 / 2, rel=1e-5)
    assert estimate.low == pytest.approx(5 - estimate.high)


def test_a_stochastic_policy_weighs_every_arm(each_by_the_others):
    half = np.full((4, 2), 0.5)
    weights = importance_weights(half, ARMS, PROPENSITIES)
    assert weights.tolist() == [1, 1, 2, 1]
    # Predictions halved over both arms, as above.
    assert direct_method(half, each_by_the_others).mean() == pytest.approx(
        (1 + 1.5 + 1.75 + 0.75) / 4
    )


def test_an_arm_without_pulls_in_a_context_has_its_mean_elsewhere():
    contexts, arms = np.array([0, 0, 1, 1]), np.array([0, 0, 0, 1])
    model = ArmMeans(contexts, arms, np.array([1.0, 3, 5, 7]), 3, 2)
    assert model.predict(np.array([0, 1])).tolist() == [[2, 7, 4], [5, 7, 4]]


# --- reward models --------------------------------------------------------------------------------


def test_regressions_find_the_weights_of_each_arm():
    rng = np.random.default_rng(0)
    contexts = rng.normal((50, -1), (10, 0.1), size=(4000, 2))
    arms = rng.integers(2, size=4000)
    weights = np.array([[0.2, 3.0], [-0.1, 8.0]])
    means = contexts @ weights.T + np.array([1.0, 2.0])
    rewards = means[np.arange(4000), arms] + rng.normal(size=4000)
    model = ArmRegressions(contexts, arms, rewards, 3)
    # The noise of 2,000 pulls and three coefficients, and a prior worth a pull.
    assert np.abs(model.predict(contexts)[:, :2] - means).max() < 0.25
    assert model.predict(contexts)[:, 2] == pytest.approx(np.full(4000, rewards.mean()))


@pytest.mark.parametrize("kind", ["means", "regressions"])
def test_sensitivity_is_the_derivative(kind):
    rng = np.random.default_rng(1)
    arms, rewards = rng.integers(3, size=30), rng.normal(size=30)
    policy = rng.dirichlet(np.ones(3), size=8)
    if kind == "means":
        contexts, asked = rng.integers(4, size=30), rng.integers(5, size=8)
    else:
        contexts, asked = rng.normal(size=(30, 2)), rng.normal(size=(8, 2))

    def model(rewards):
        if kind == "means":
            return ArmMeans(contexts, arms, rewards, 3, 5)
        return ArmRegressions(contexts, arms, rewards, 3)

    def total(rewards):
        return float((policy * model(rewards).predict(asked)).sum())

    sensitivity = model(rewards).sensitivity(asked, policy)
    for first, second in ((0, 1), (5, 17), (29, 3)):
        # One up and one down, which leaves the mean reward as it is.
        moved = rewards.copy()
        moved[[first, second]] += 1, -1
        derivative = total(moved) - total(rewards)
        assert derivative == pytest.approx(sensitivity[first] - sensitivity[second])


# --- laws -----------------------------------------------------------------------------------------

FINITE = st.floats(-100, 100, width=32)


@given(st.data())
def test_the_logging_policy_is_worth_what_the_log_says(data):
    n = data.draw(st.integers(2, 30))
    rewards = data.draw(arrays.arrays(np.float64, n, elements=FINITE))
    arms = data.draw(arrays.arrays(np.int64, n, elements=st.integers(0, 2)))
    logging = np.random.default_rng(n).dirichlet(np.ones(3) * 5, size=n)
    weights = importance_weights(logging, arms, logging[np.arange(n), arms])
    assert ips(weights, rewards).mean() == pytest.approx(rewards.mean(), abs=1e-9)
    assert snips(weights, rewards).mean() == pytest.approx(rewards.mean(), abs=1e-9)
    assert effective_sample_size(weights) == pytest.approx(n)


@given(st.data())
def test_self_normalised_estimates_lie_among_the_rewards_and_move_with_them(data):
    n = data.draw(st.integers(2, 30))
    rewards = data.draw(arrays.arrays(np.float64, n, elements=FINITE))
    weights = data.draw(arrays.arrays(np.float64, n, elements=st.floats(0.01, 100)))
    estimate = snips(weights, rewards).mean()
    assert rewards.min() - 1e-6 <= estimate <= rewards.max() + 1e-6
    assert snips(weights, rewards + 5).mean() == pytest.approx(estimate + 5, abs=1e-6)


def test_doubly_robust_and_direct_move_with_the_rewards():
    _, arms, rewards, propensities, model, policy = drawn_log(500, UNEVEN, seed=0)
    terms = evaluate_policy(policy, arms, rewards, propensities, model)
    shifted = cross_fit(model.contexts, arms, rewards + 5, 3)
    moved = evaluate_policy(policy, arms, rewards + 5, propensities, shifted)
    assert moved.doubly_robust == pytest.approx(terms.doubly_robust + 5)
    assert moved.direct == pytest.approx(terms.direct + 5)


# --- against the truth ----------------------------------------------------------------------------


def drawn_log(n, logging, seed, rates=None):
    """Pulls of SegmentBandit by a policy of given chances, drawn all at once."""
    env = gym.make("SegmentBandit-v0").unwrapped
    rates = env.means if rates is None else rates
    rng = np.random.default_rng(seed)
    contexts = rng.choice(2, size=n, p=env.context_probabilities)
    arms = (logging[contexts].cumsum(axis=1) < rng.random((n, 1))).sum(axis=1)
    rewards = (rng.random(n) < rates[contexts, arms]).astype(np.float64)
    model = cross_fit(contexts, arms, rewards, 3, seed=seed)
    return contexts, arms, rewards, logging[contexts, arms], model, BY_SEGMENT[contexts]


def write_unevenly(env, n, seed, path):
    """What `log_uniformly` writes, by the policy ``UNEVEN``."""
    # The environment draws from a stream of its seed: the arms need another.
    rng = np.random.default_rng([seed, 1])
    context, _ = env.reset(seed=seed)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["context", "arm", "reward", "propensity"])
        for _ in range(n):
            arm = int(rng.choice(3, p=UNEVEN[context]))
            shown = context
            context, reward, _, truncated, _ = env.step(arm)
            writer.writerow([shown, arm, reward, UNEVEN[shown, arm]])
            if truncated:
                context, _ = env.reset()


@pytest.mark.parametrize("write", [log_uniformly, write_unevenly])
def test_estimates_from_files_hit_the_truth_on_average(write, tmp_path):
    """60 logs of 500 pulls; within four standard errors of their mean."""
    env = gym.make("SegmentBandit-v0")
    estimates = []
    for seed in range(60):
        write(env, 500, seed, tmp_path / "log.csv")
        data = read_log(tmp_path / "log.csv")
        contexts = data.observations(env.observation_space)
        model = cross_fit(contexts, data.arms, data.rewards, 3)
        terms = evaluate_policy(
            BY_SEGMENT[contexts], data.arms, data.rewards, data.propensities, model
        )
        estimates.append([getattr(terms, name).mean() for name in ESTIMATORS])
    env.close()
    error = np.std(estimates, axis=0, ddof=1) / np.sqrt(60)
    assert (np.abs(np.mean(estimates, axis=0) - TRUTH) < 4 * error).all()
    assert (error < 0.015).all()


@pytest.fixture(scope="module")
def many_logs():
    """Estimates and intervals of 1,000 logs of 1,000 pulls by the policy ``UNEVEN``."""
    points, covered, widths = [], [], []
    for seed in range(1000):
        _, *log = drawn_log(1000, UNEVEN, seed)
        arms, rewards, propensities, model, policy = log
        terms = evaluate_policy(policy, arms, rewards, propensities, model)
        intervals = [mean_reward(getattr(terms, name)) for name in ESTIMATORS]
        points.append([interval.point for interval in intervals])
        covered.append([interval.low <= TRUTH <= interval.high for interval in intervals])
        widths.append([(interval.high - interval.low) / 2 for interval in intervals])
    return np.array(points), np.array(covered), np.array(widths)


def test_estimates_hit_the_truth_on_average(many_logs):
    points, _, _ = many_logs
    bias, error = points.mean(axis=0) - TRUTH, points.std(axis=0) / np.sqrt(len(points))
    # The self-normalised one is biased, by order 1/n: it is held to the same tolerance here.
    assert (np.abs(bias) < 3.5 * error).all()
    assert (error < 0.002).all()


def test_intervals_cover_the_truth_as_often_as_they_say(many_logs):
    points, covered, widths = many_logs
    # 95 % of 1,000 have a standard error of 0.7 %; clicks are rare, and so intervals a bit short.
    assert (covered.mean(axis=0) > 0.92).all()
    assert (covered.mean(axis=0) < 0.97).all()
    assert widths.mean(axis=0) / 1.96 == pytest.approx(points.std(axis=0), rel=0.08)


def test_doubly_robust_varies_less_than_inverse_propensities():
    rates = np.array([[0.7, 0.9, 0.5], [0.8, 0.6, 0.5]])
    points = []
    for seed in range(300):
        _, *log = drawn_log(500, UNEVEN, seed, rates)
        arms, rewards, propensities, model, policy = log
        terms = evaluate_policy(policy, arms, rewards, propensities, model)
        points.append([terms.ips.mean(), terms.doubly_robust.mean()])
    inverse, robust = np.var(points, axis=0)
    # A pull's variance is 6.26, and with a perfect model 1.26. A ratio of variances of 300 has a
    # standard error of a sixth of it at most.
    assert inverse / robust == pytest.approx(6.26 / 1.26, rel=0.4)
    assert np.mean(points, axis=0) == pytest.approx([0.3 * 0.9 + 0.7 * 0.8] * 2, abs=0.03)


def test_a_wrong_model_biases_the_direct_method_and_not_the_doubly_robust():
    """The model is told that everybody is of one segment."""
    points = []
    for seed in range(300):
        contexts, arms, rewards, propensities, _, policy = drawn_log(1000, UNEVEN, seed)
        model = cross_fit(np.zeros_like(contexts), arms, rewards, 3)
        terms = evaluate_policy(policy, arms, rewards, propensities, model)
        points.append([terms.direct.mean(), terms.doubly_robust.mean()])
    direct, robust = np.mean(points, axis=0)
    error = np.std(points, axis=0) / np.sqrt(len(points))
    assert abs(direct - TRUTH) > 10 * error[0]
    assert abs(robust - TRUTH) < 4 * error[1]


def test_regressions_on_the_linear_bandit():
    """Rewards linear in the features: every estimator finds what the greedy policy earns."""
    env = gym.make("LinearBandit-v0", arm_parameters=[[1.0, 0], [0, 1], [-1, 0]]).unwrapped
    rng = np.random.default_rng(0)
    everybody = rng.uniform(-1, 1, size=(200_000, 2)) @ env.arm_parameters.T
    truth = everybody.max(axis=1).mean()
    points = []
    for _ in range(100):
        contexts = rng.uniform(-1, 1, size=(500, 2))
        means = contexts @ env.arm_parameters.T
        arms = rng.integers(3, size=500)
        rewards = means[np.arange(500), arms] + rng.normal(size=500)
        policy = np.eye(3)[means.argmax(axis=1)]
        model = cross_fit(contexts, arms, rewards, 3)
        terms = evaluate_policy(policy, arms, rewards, np.full(500, 1 / 3), model)
        points.append([getattr(terms, name).mean() for name in ESTIMATORS])
    error = np.std(points, axis=0) / 10
    assert (np.abs(np.mean(points, axis=0) - truth) < 4 * error + 0.002).all()
    assert np.std(points, axis=0)[2] < np.std(points, axis=0)[0]


# --- replay ---------------------------------------------------------------------------------------


def test_replay_of_a_uniform_log_is_the_self_normalised_estimate(tmp_path):
    log = tmp_path / "log.csv"
    with gym.make("SegmentBandit-v0") as env:
        log_uniformly(env, 800, 3, log)
    total, done = 0.0, False
    with gym.make("ReplayBandit-v0", log=log) as env:
        context, _ = env.reset()
        while not done:
            context, reward, _, done, info = env.step(int(BY_SEGMENT[context].argmax()))
            total += reward
    data = read_log(log)
    contexts = data.observations(data.observation_space)
    weights = importance_weights(BY_SEGMENT[contexts], data.arms, data.propensities)
    assert total / info["matched_pulls"] == pytest.approx(snips(weights, data.rewards).mean())
    assert 3 * total / 800 == pytest.approx(ips(weights, data.rewards).mean())
    assert effective_sample_size(weights) == pytest.approx(info["matched_pulls"])


# --- refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"propensities": [0.5, 0, 0.25, 0.5]}, "propensity of pull 2 is 0, it must be above 0"),
        ({"propensities": [0.5, 0.5, 0.25, np.nan]}, "propensity of pull 4 is nan"),
        ({"propensities": [0.5, 0.5, 1.25, 1]}, "propensity of pull 3 is 1.25"),
        ({"propensities": [0.5]}, r"not \(4,\) and \(1,\)"),
        ({"rewards": [1, np.inf, 0, 0]}, "reward of pull 2 is inf, it must be finite"),
        ({"rewards": [1, 0]}, r"4 pulls need as many rewards, not \(2,\)"),
        ({"arms": [0, 0, 1, 2]}, "arms must lie between 0 and 1"),
        ({"arms": [0, 0, 0, 0]}, "arm 1 was never logged, and the policy chooses it for 100.0%"),
        ({"policy": [[0.0, 0.9]] * 4}, "probabilities of pull 1 is 0.9, it must be 1"),
        ({"policy": [[-1.0, 2]] * 4}, "probabilities of pull 1"),
    ],
)
def test_what_is_no_log_is_refused(each_by_the_others, change, message):
    given = {
        "policy": ALWAYS_1,
        "arms": ARMS,
        "rewards": REWARDS,
        "propensities": PROPENSITIES,
        **{name: np.array(values) for name, values in change.items()},
    }
    with pytest.raises(ValueError, match=message) as error:
        evaluate_policy(*given.values(), each_by_the_others)
    assert "\n" not in str(error.value)


def test_a_log_that_never_showed_an_arm_to_a_segment_is_refused():
    """Segment 1 never saw treatment 0, which is what the policy shows it."""
    logging = np.array([[0.5, 0.25, 0.25], [0, 0.5, 0.5]])
    contexts, arms, _, propensities, _, policy = drawn_log(500, logging, seed=0)
    weights = importance_weights(policy, arms, propensities)
    with pytest.raises(
        ValueError, match=r"too little of what the policy does: its weights are 0\.\d"
    ):
        check_support(policy, arms, weights)
    check_support(
        BY_SEGMENT[1 - contexts],
        arms,
        importance_weights(BY_SEGMENT[1 - contexts], arms, propensities),
    )


def test_propensities_that_cannot_be_right_are_refused():
    _, arms, rewards, propensities, model, policy = drawn_log(2000, UNEVEN, seed=0)
    with pytest.raises(ValueError, match=r"propensities are too small: the weights are \d"):
        evaluate_policy(policy, arms, rewards, propensities / 2, model)


def test_right_propensities_are_never_refused():
    for seed in range(300):
        _, arms, _, propensities, _, policy = drawn_log(300, UNEVEN, seed)
        check_support(policy, arms, importance_weights(policy, arms, propensities))


def test_a_policy_that_agrees_nowhere_is_refused():
    policy = np.eye(2)[[0, 1, 0]]
    with pytest.raises(ValueError, match="none of the logged pulls"):
        check_support(policy, np.array([1, 0, 1]), np.zeros(3))


def test_a_log_without_chance_tells_of_no_other_policy():
    """Half of the pulls agree, and all of them were certain."""
    policy, arms = np.eye(2)[[0, 1, 0, 1]], np.array([0, 0, 1, 1])
    weights = importance_weights(policy, arms, np.ones(4))
    with pytest.raises(ValueError, match=r"weights are 0\.5 on average"):
        check_support(policy, arms, weights)


def test_a_single_pull_makes_no_model():
    with pytest.raises(ValueError, match="two pulls and two folds or more: there are 1 and 5"):
        cross_fit(np.zeros(1, np.int64), np.zeros(1, np.int64), np.ones(1), 2)


# --- differences ----------------------------------------------------------------------------------


def test_a_difference_by_hand(each_by_the_others):
    always_0 = np.array([[1.0, 0]] * 4)
    one, two = (
        evaluate_policy(policy, ARMS, REWARDS, PROPENSITIES, each_by_the_others)
        for policy in (ALWAYS_1, always_0)
    )
    assert one.errors.tolist() == [1, -1, -2, 2]
    assert one.weights.tolist() == [0, 0, 4, 2]
    found = difference_in_value(one, two)
    terms = one.doubly_robust - two.doubly_robust
    # Their variance, 19.5, is above the floor of 7 * 2.5; the t is of 3 degrees of freedom.
    assert terms.tolist() == [0, 3, -5.5, 4.5]
    half = 3.1824463 * np.sqrt(19.5 / 4)
    assert (found.point, found.high - found.point) == pytest.approx((0.5, half))
    assert found.point - found.low == pytest.approx(half)
    assert difference_in_value(one, one) == Estimate(0.0, 0.0, 0.0, 4)
    # As one of ten.
    wider = difference_in_value(one, two, n_comparisons=10)
    assert wider.high - wider.point == pytest.approx(half * 7.4533185 / 3.1824463)


def test_an_arm_without_a_click_in_few_pulls_is_not_surely_worse():
    arms = np.repeat([0, 1], [20, 380])
    rewards = np.zeros(400)
    rewards[20::20] = 1  # a click in twenty, which 20 pulls may miss by chance
    propensities = np.where(arms == 0, 0.05, 0.95)
    model = cross_fit(np.zeros(400, np.int64), arms, rewards, 2)
    never = np.tile([1.0, 0.0], (400, 1))
    first = evaluate_policy(never, arms, rewards, propensities, model)
    logged = terms_as_logged(arms, rewards, model)
    naive = paired_difference(first.doubly_robust, logged.doubly_robust)
    assert naive.high < 0
    found = difference_in_value(first, logged)
    assert found.point == naive.point == pytest.approx(-0.0475)
    # The weights are 20 - 1 in 20 of 400 pulls, and 0 - 1 in the others.
    floor = np.sqrt((20 * 19**2 + 380) / 400 * (logged.errors**2).mean() / 400)
    assert found.high == pytest.approx(-0.0475 + 1.965927 * floor)
    assert found.low < 0 < found.high


def test_policies_that_are_worth_the_same_are_seldom_told_apart():
    """In 200 logs of few clicks in which every arm is worth the same, 3 policies, all alternatives.

    Wrong in 5 % of them at most; 20 or more of 200 would come of that in 1 case of 400.
    """
    rng = np.random.default_rng(0)
    chances, wrong = np.array([0.1, 0.9]), 0
    for _ in range(200):
        contexts, arms = rng.integers(2, size=500), rng.choice(2, size=500, p=chances)
        rewards = (rng.random(500) < 0.05).astype(np.float64)
        model = cross_fit(contexts, arms, rewards, 2)
        policies = [np.tile(row, (500, 1)) for row in np.eye(2)]
        policies += [np.eye(2)[order][contexts] for order in ([0, 1], [1, 0])]
        terms = [evaluate_policy(p, arms, rewards, chances[arms], model) for p in policies]
        terms.append(terms_as_logged(arms, rewards, model))
        pairs = list(combinations(terms, 2))
        found = [difference_in_value(one, two, len(pairs)) for one, two in pairs]
        wrong += any(difference.low > 0 or difference.high < 0 for difference in found)
    assert wrong < 20


# --- Where a log stops being one: each limit from both of its sides.

TINY = 5e-324  # the smallest number above 0
JUST_ABOVE_1 = np.nextafter(1, 2)
HALF = np.full((3, 2), 0.5)


def weights_of(policy=HALF, arms=(0, 1, 0), propensities=(0.5, 0.5, 0.5)):
    return importance_weights(np.array(policy), np.array(arms), np.array(propensities))


# --- what is handed over --------------------------------------------------------------------------


@pytest.mark.parametrize("arms", [(0, 0, 0), (1, 1, 1), (0, 1, 1)])
def test_arms_from_the_first_to_the_last(arms):
    assert weights_of(arms=arms).tolist() == [1, 1, 1]


@pytest.mark.parametrize("arms", [(0, 1, -1), (-1, 0, 0), (-2, 0, 0), (0, 1, 2), (7, 0, 0)])
def test_codes_that_are_no_arms(arms):
    """Python would take -1 for the last arm."""
    with pytest.raises(ValueError, match="arms must lie between 0 and 1, as the policy's columns"):
        weights_of(arms=arms)


@pytest.mark.parametrize("propensity", [1e-300, 0.5, np.nextafter(1, 0), 1.0])
def test_propensities_above_0_and_up_to_1(propensity):
    assert weights_of(propensities=(0.5, propensity, 0.5))[1] == 0.5 / propensity


@pytest.mark.parametrize("propensity", [0.0, -TINY, -0.5, JUST_ABOVE_1, 1.5, np.nan, np.inf])
def test_numbers_that_are_no_propensities(propensity):
    with pytest.raises(ValueError, match=r"propensity of pull 2 is .*, it must be above 0 and at"):
        weights_of(propensities=(0.5, propensity, 0.5))


@pytest.mark.parametrize("row", [(0, 1), (1, 0), (0.3, 0.7), (0.5, 0.5 + 9e-7), (0.5, 0.5 - 9e-7)])
def test_rows_that_sum_to_1_but_for_rounding(row):
    assert weights_of(policy=[row, *HALF[1:]])[0] == row[0] / 0.5


@pytest.mark.parametrize(
    "row", [(0.5, 0.5 + 2e-6), (0.5, 0.5 - 2e-6), (-TINY, 1), (1.5, -0.5), (0.5, np.nan), (0, 0)]
)
def test_rows_that_are_no_distributions(row):
    with pytest.raises(ValueError, match=r"sum of the policy's probabilities of pull 2 is .*be 1$"):
        weights_of(policy=[HALF[0], row, HALF[2]])


@pytest.mark.parametrize(
    ("arms", "propensities"),
    [
        ((0, 1), (0.5, 0.5, 0.5)),
        ((0, 1, 0, 1), (0.5, 0.5, 0.5)),
        ((0, 1, 0), (0.5, 0.5)),
        ((0, 1, 0), (0.5, 0.5, 0.5, 0.5)),
        ([[0], [1], [0]], (0.5, 0.5, 0.5)),
    ],
)
def test_one_arm_and_one_propensity_for_each_pull(arms, propensities):
    with pytest.raises(ValueError, match=r"a policy of shape \(3, 2\) needs 3 arms and propens"):
        weights_of(arms=arms, propensities=propensities)


def test_no_pulls_have_no_weights():
    nothing = np.zeros(0)
    assert importance_weights(np.zeros((0, 2)), nothing.astype(np.int64), nothing).shape == (0,)


@pytest.mark.parametrize("reward", [0.0, -1e308, 1e308, TINY])
def test_rewards_of_any_size(reward):
    check_rewards(np.array([1.0, reward]), 2)


@pytest.mark.parametrize("reward", [np.nan, np.inf, -np.inf])
def test_rewards_that_are_no_numbers(reward):
    with pytest.raises(ValueError, match=r"reward of pull 2 is .*, it must be finite"):
        check_rewards(np.array([1.0, reward]), 2)


@pytest.mark.parametrize("shape", [(1,), (3,), (2, 1), ()])
def test_one_reward_for_each_pull(shape):
    with pytest.raises(ValueError, match="2 pulls need as many rewards"):
        check_rewards(np.ones(shape), 2)


# --- what a log can tell --------------------------------------------------------------------------


def supported(weights):
    """Whether a log with these weights is accepted, for a policy that it shows every arm of."""
    arms = np.arange(len(weights)) % 2
    try:
        check_support(np.full((len(weights), 2), 0.5), arms, np.asarray(weights))
    except ValueError as error:
        return str(error)
    return "supported"


@pytest.mark.parametrize(
    ("share", "outcome"), [(0.0, None), (TINY, "arm 1 was never logged"), (0.5, "arm 1 was never")]
)
def test_an_arm_that_was_never_logged_matters_where_the_policy_chooses_it(share, outcome):
    policy = np.array([[1 - share, share]] * 2)
    if outcome is None:
        check_support(policy, np.zeros(2, int), np.ones(2))
    else:
        with pytest.raises(ValueError, match=outcome):
            check_support(policy, np.zeros(2, int), np.ones(2))


@pytest.mark.parametrize(
    ("weight", "n", "outcome"),
    [
        # Equal weights below 1 have no spread: what files round remains, 0.02.
        (0.981, 100, "supported"),
        (0.979, 100, "the log holds too little of what the policy does: its weights are 0.979"),
        # Above 1 by x, the variance for a mean of 1 is x: x = 5 sqrt(x / n) + 0.02.
        (1.288, 100, "supported"),
        (1.289, 100, "the propensities are too small: the weights are 1.29 on average"),
        (1.0206, 1_000_000, "supported"),
        (1.0209, 1_000_000, "the propensities are too small: the weights are 1.02 on average"),
    ],
)
def test_equal_weights(weight, n, outcome):
    assert supported(np.full(n, weight)).startswith(outcome)


@pytest.mark.parametrize(
    ("n_twos", "outcome"),
    [
        # Of weights 0 and 2 the variance for a mean of 1 is 1: 100 may miss it by 5 / 10 + 0.02.
        (25, "supported"),
        (23, "the log holds too little of what the policy does: its weights are 0.46"),
        (0, "the policy would have made none of the logged pulls"),
    ],
)
def test_weights_of_which_some_are_0(n_twos, outcome):
    assert supported([2.0] * n_twos + [0.0] * (100 - n_twos)).startswith(outcome)


def test_what_weights_are_worth():
    assert effective_sample_size(np.zeros(3)) == 0
    assert effective_sample_size(np.array([0, 0, 5.0])) == 1
    assert effective_sample_size(np.array([1.0, 3.0])) == 16 / 10


@pytest.mark.parametrize(("n_pulls", "n_folds"), [(2, 2), (2, 5), (3, 2), (7, 3)])
def test_two_pulls_and_two_folds_are_enough(n_pulls, n_folds):
    zeros = np.zeros(n_pulls, np.int64)
    fitted = cross_fit(zeros, zeros, np.ones(n_pulls), 1, n_folds=n_folds)
    assert len(fitted.models) == min(n_folds, n_pulls)
    # No fold is empty, and none is larger than another by more than one pull.
    sizes = np.bincount(fitted.fold, minlength=len(fitted.models))
    assert sizes.max() - sizes.min() <= 1
    assert fitted.predicted.tolist() == [[1.0]] * n_pulls


@pytest.mark.parametrize(("n_pulls", "n_folds"), [(1, 2), (0, 2), (2, 1), (5, 1), (5, 0)])
def test_fewer_are_not(n_pulls, n_folds):
    zeros = np.zeros(n_pulls, np.int64)
    with pytest.raises(ValueError, match=f"or more: there are {n_pulls} and {n_folds}"):
        cross_fit(zeros, zeros, np.ones(n_pulls), 1, n_folds=n_folds)

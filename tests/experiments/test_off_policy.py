"""Off-policy estimates: by hand, against click rates known exactly, and of agents on logs."""

from contextlib import nullcontext

import gymnasium as gym
import numpy as np
import pytest

from rl_yardstick.agents import load_algorithm
from rl_yardstick.envs.bandits import ReplayBandit
from rl_yardstick.experiments import off_policy as ope
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.run import FINISHED, Run
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.verdicts import Estimate

ESTIMATORS = ("ips", "snips", "doubly_robust")


ARMS = np.array([0, 0, 1, 1])
REWARDS = np.array([1.0, 0, 1, 3])
PROPENSITIES = np.array([0.5, 0.5, 0.25, 0.5])
ALWAYS_1 = np.array([[0.0, 1]] * 4)


@pytest.fixture
def each_by_the_others():
    """One context, and as many folds as pulls: each predicted by the mean of its arm's others."""
    return ope.cross_fit(np.zeros(4, np.int64), ARMS, REWARDS, 2, n_folds=4)


def test_the_estimators_by_hand(each_by_the_others):
    expected = [[0, 2], [1, 2], [0.5, 3], [0.5, 1]]  # without the pull itself
    assert each_by_the_others == pytest.approx(np.array(expected))
    weights = ope.importance_weights(ALWAYS_1, ARMS, PROPENSITIES)
    assert weights.tolist() == [0, 0, 4, 2]
    assert ope.ips(weights, REWARDS).tolist() == [0, 0, 4, 6]
    # The ratio is 10 / 6; the mean weight 1.5.
    ratio = 10 / 6
    by_hand = [ratio, ratio, ratio + 4 * (1 - ratio) / 1.5, ratio + 2 * (3 - ratio) / 1.5]
    assert ope.snips(weights, REWARDS) == pytest.approx(np.array(by_hand))
    assert ope.snips(weights, REWARDS).mean() == pytest.approx(ratio)
    terms = ope.doubly_robust(ALWAYS_1, weights, ARMS, REWARDS, each_by_the_others)
    assert terms == pytest.approx(np.array([2, 2, 3 + 4 * (1 - 3), 1 + 2 * (3 - 1)]))
    assert ope.effective_sample_size(weights) == pytest.approx(36 / 20)
    assert ope.effective_sample_size(np.zeros(3)) == 0
    # A stochastic policy weighs every arm.
    half = np.full((4, 2), 0.5)
    assert ope.importance_weights(half, ARMS, PROPENSITIES).tolist() == [1, 1, 2, 1]


def test_a_difference_by_hand(each_by_the_others):
    one, two = (
        ope.evaluate_policy(policy, ARMS, REWARDS, PROPENSITIES, each_by_the_others)
        for policy in (ALWAYS_1, 1 - ALWAYS_1)
    )
    assert one.errors.tolist() == [1, -1, -2, 2]
    assert one.weights.tolist() == [0, 0, 4, 2]
    terms = one.doubly_robust - two.doubly_robust
    # Their variance, 19.5, is above the floor of 7 * 2.5; the t is of 3 degrees of freedom.
    assert terms.tolist() == [0, 3, -5.5, 4.5]
    half = 3.1824463 * np.sqrt(19.5 / 4)
    found = ope.difference_in_value(one, two)
    assert (found.point, found.high - found.point) == pytest.approx((0.5, half))
    assert found.point - found.low == pytest.approx(half)
    assert ope.difference_in_value(one, one) == Estimate(0.0, 0.0, 0.0, 4)
    wider = ope.difference_in_value(one, two, n_comparisons=10)
    assert wider.high - wider.point == pytest.approx(half * 7.4533185 / 3.1824463)


def test_an_arm_without_a_click_in_few_pulls_is_not_surely_worse():
    arms = np.repeat([0, 1], [20, 380])
    rewards = np.zeros(400)
    rewards[20::20] = 1  # a click in twenty, which 20 pulls may miss by chance
    model = ope.cross_fit(np.zeros(400, np.int64), arms, rewards, 2)
    never, propensities = np.tile([1.0, 0.0], (400, 1)), np.where(arms == 0, 0.05, 0.95)
    first = ope.evaluate_policy(never, arms, rewards, propensities, model)
    logged = ope.terms_as_logged(arms, rewards, model)
    naive = ope.mean_reward(first.doubly_robust - logged.doubly_robust)
    assert naive.high < 0
    found = ope.difference_in_value(first, logged)
    assert found.point == naive.point == pytest.approx(-0.0475)
    # The weights are 20 - 1 in 20 of 400 pulls, and 0 - 1 in the others.
    floor = np.sqrt((20 * 19**2 + 380) / 400 * (logged.errors**2).mean() / 400)
    assert found.high == pytest.approx(-0.0475 + 1.965927 * floor)
    assert found.low < 0 < found.high


def test_a_ridge_regression_for_each_arm():
    """Against the same by least squares, with a row for each coefficient's prior."""
    rng = np.random.default_rng(1)
    contexts, arms, rewards = rng.normal(size=(30, 2)), np.arange(30) % 2, rng.normal(size=30)
    found = ope.arm_regressions(contexts, arms, rewards, 3, contexts[:4])
    scaled = (contexts - contexts.mean(axis=0)) / contexts.std(axis=0)
    inputs = np.column_stack([np.ones(30), scaled])
    for arm in range(2):
        rows = np.vstack([inputs[arms == arm], np.eye(3)])
        wanted = np.append(rewards[arms == arm] - rewards.mean(), np.zeros(3))
        coefficients = np.linalg.lstsq(rows, wanted)[0]
        assert found[:, arm] == pytest.approx(rewards.mean() + inputs[:4] @ coefficients)
    assert found[:, 2] == pytest.approx(np.full(4, rewards.mean()))  # without a pull


# The best treatment for each segment, at .159 clicks a user.
BY_SEGMENT = np.array([[0.0, 1, 0], [1, 0, 0]])
TRUTH = 0.3 * 0.25 + 0.7 * 0.12


def test_estimates_hit_the_truth_and_intervals_cover_it_as_often_as_they_say():
    # A logging policy that looks at the segment, and never rules a treatment out.
    uneven = np.array([[0.6, 0.2, 0.2], [0.1, 0.3, 0.6]])
    with gym.make("SegmentBandit-v0") as env:
        rates, shares = env.unwrapped.means, env.unwrapped.context_probabilities
    points, covered = [], []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        contexts = rng.choice(2, size=1000, p=shares)
        arms = (uneven[contexts].cumsum(axis=1) < rng.random((1000, 1))).sum(axis=1)
        rewards = (rng.random(1000) < rates[contexts, arms]).astype(np.float64)
        model = ope.cross_fit(contexts, arms, rewards, 3)
        policy, propensities = BY_SEGMENT[contexts], uneven[contexts, arms]
        terms = ope.evaluate_policy(policy, arms, rewards, propensities, model)
        intervals = [ope.mean_reward(getattr(terms, name)) for name in ESTIMATORS]
        points.append([interval.point for interval in intervals])
        covered.append([interval.low <= TRUTH <= interval.high for interval in intervals])
    error = np.std(points, axis=0) / np.sqrt(150)
    # The self-normalised one is biased, by order 1/n: it is held to the same tolerance here.
    assert (np.abs(np.mean(points, axis=0) - TRUTH) < 3.5 * error).all()
    assert (error < 0.005).all()
    # 95 % of 150 have a standard error of 1.8 %; clicks are rare, and so intervals a bit short.
    assert (np.mean(covered, axis=0) > 0.89).all()
    assert (np.mean(covered, axis=0) < 0.995).all()


TOO_LITTLE = "the log holds too little of what the policy does: its weights are 0.979"
TOO_SMALL = "the propensities are too small: the weights are 1.29 on average"
# What stands in a column of a log of both arms in turn, and what is said of it.
LOGS = [
    ("arms", 0, r"arm 1 was never logged, and the policy chooses it for 50\.0%"),
    # Equal weights below 1 have no spread: what files round remains, 0.02.
    ("propensities", 0.5 / 0.981, None),
    ("propensities", 0.5 / 0.979, TOO_LITTLE),
    # Above 1 by x, the variance for a mean of 1 is x: x = 5 sqrt(x / n) + 0.02.
    ("propensities", 0.5 / 1.288, None),
    ("propensities", 0.5 / 1.289, TOO_SMALL),
]


@pytest.mark.parametrize(("name", "value", "refusal"), LOGS)
def test_what_a_policy_is_judged_on(name, value, refusal):
    arms, rewards = np.arange(100) % 2, np.zeros(100)
    model = ope.cross_fit(np.zeros(100, np.int64), arms, rewards, 2)
    given = {"policy": np.full((100, 2), 0.5), "arms": arms, "rewards": rewards}
    given |= {"propensities": np.full(100, 0.5), name: np.full(100, value)}
    with pytest.raises(ValueError, match=refusal) if refusal else nullcontext():
        ope.evaluate_policy(**given, predicted=model)


NUMBERS = "".join(f"{i % 2},{i % 3 % 2},{i % 5},0.5\n" for i in range(60))
NUMBERS = f"segment,arm,reward,propensity\n{NUMBERS}"
WORDS = NUMBERS.replace("\n0,", "\ncasual,").replace("\n1,", "\ncore,")


@pytest.fixture
def log(tmp_path):
    def written(text, name="log.csv"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return written


def random_agent(path, trained_on=None):
    agent = load_algorithm("random")("RandomPolicy", ReplayBandit(path), seed=0)
    return ope.LoggedPolicy("runs/random", agent, trained_on)


def test_the_policies_asked_about_stand_before_their_alternatives(log):
    path = log(NUMBERS)
    comparison = ope.compare_policies(ope.read_logged(path), [random_agent(path)] * 2)
    names = ["runs/random", "runs/random", "always arm 0", "always arm 1", "as logged"]
    assert [row.name for row in comparison.rows] == names
    assert [row.is_given for row in comparison.rows] == [True, True, False, False, False]
    given, _, first, second, logged = (row.terms for row in comparison.rows)
    # Both arms were logged with probability 1/2, and so the random policy as often as the log.
    assert given.ips.tolist() == logged.ips.tolist() == [i % 5 for i in range(60)]
    assert (first.ips + second.ips) / 2 == pytest.approx(logged.ips)
    assert (given.effective, logged.effective) == (60, 60)
    # Figures on the log that an agent was trained on flatter it. Another file, even of the same
    # pulls, is another log; and one that is gone is not known.
    notes = ("runs/random was trained on this log: its figures flatter it; judge by another",)
    others = (log(NUMBERS, "same.csv"), path.with_name("gone.csv"), None)
    for trained_on, expected in {path: notes, **dict.fromkeys(others, ())}.items():
        agent = random_agent(path, trained_on)
        assert ope.compare_policies(ope.read_logged(path), [agent]).notes == expected


def test_an_agent_that_numbered_contexts_otherwise_is_refused(log):
    theirs, ours = log(NUMBERS, "theirs.csv"), log(WORDS, "ours.csv")
    with pytest.raises(UserError) as error:
        ope.compare_policies(ope.read_logged(ours), [random_agent(ours, theirs)])
    message = f"runs/random was trained on {theirs}, whose contexts are numbers; those of {ours} "
    assert str(error.value) == f"{message}are casual, core"


def test_an_agent_is_read_with_the_log_it_was_trained_on(log, tmp_path):
    path, folder = log(NUMBERS), tmp_path / "run"
    folder.mkdir()
    load_algorithm("linucb")(env=ReplayBandit(path), seed=0).save(folder / "ReplayBandit-v0.zip")

    def read(place, **fields):
        spec = TrainSpec(algo="linucb", env_id="ReplayBandit-v0", n_timesteps=1, **fields)
        Run(folder).record(spec, FINISHED)
        return ope.load_policy(place)

    for place in (folder, folder / "ReplayBandit-v0.zip"):
        policy = read(place, env_kwargs={"log": str(path)})
        assert (policy.name, policy.log) == (str(place), path)
        assert isinstance(policy.agent, load_algorithm("linucb"))
    with pytest.raises(UserError, match="trained with frame_stack: it observes more than"):
        read(folder, frame_stack=2)
    (folder / "run.json").unlink()
    assert ope.load_policy(folder / "ReplayBandit-v0.zip").log is None


def test_a_log_may_name_its_columns_otherwise(log):
    names = {"arm": "item_id", "reward": "click", "propensity": "pscore"}
    theirs = NUMBERS.replace("arm,reward,propensity", "item_id,click,pscore")
    ours = ope.read_logged(log(NUMBERS))
    found = ope.read_logged(log(theirs, "theirs.csv"), names)
    assert found.arms.tolist() == ours.arms.tolist()
    assert found.propensities.tolist() == ours.propensities.tolist()
    with pytest.raises(UserError, match="no column 'arm'"):
        ope.read_logged(log(theirs, "theirs.csv"))

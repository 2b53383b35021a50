"""Words on pairs of agents: against SciPy's tests, by hand, and their logic on any scores."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from rl_yardstick.verdicts import judge

NAN = math.nan


def only(study):
    (pair,) = study.pairs
    return pair


def pair_of(study, environment, first, second):
    """The verdict on the first of two agents."""
    seen = [one for pair in study.pairs for one in (pair, pair.swapped())]
    here = [one for one in seen if one.environment == environment]
    return next(one for one in here if (one.first, one.second) == (first, second))


def drawn(seed, n, *means, spread=0.1):
    rng = np.random.default_rng(seed)
    return {f"a{k}": rng.normal(mean, spread, n) for k, mean in enumerate(means)}


@pytest.mark.parametrize("n", [(8, 8), (6, 20)])
def test_differences_are_welchs_and_ties_are_two_one_sided_tests(n):
    x, y = (np.random.default_rng(k).normal(0.5 + 0.05 * k, 0.1 + 0.1 * k, n[k]) for k in (0, 1))
    pair = only(judge({"world": {"x": x, "y": y}}, margin=0.1))
    found = stats.ttest_ind(x, y, equal_var=False)
    assert pair.p_different == pytest.approx(found.pvalue)
    sides = [
        stats.ttest_ind(x + 0.1, y, equal_var=False, alternative="greater").pvalue,
        stats.ttest_ind(x - 0.1, y, equal_var=False, alternative="less").pvalue,
    ]
    assert pair.p_tied == pytest.approx(max(sides))
    # The only pair has the whole level for differences, 4 %.
    ends = found.confidence_interval(0.96)
    assert pair.interval == pytest.approx((ends.low, ends.high))


def test_paired_runs_are_compared_seed_by_seed():
    x, y = np.random.default_rng(0).random((2, 9))
    y[2] = x[5] = NAN
    pair = only(judge({"world": {"x": x, "y": y}}, margin=0, paired=True))
    both = [0, 1, 3, 4, 6, 7, 8]
    assert pair.p_different == pytest.approx(stats.ttest_rel(x[both], y[both]).pvalue)
    assert pair.n == 7


def test_holm_corrects_all_pairs_of_all_environments_in_each_family():
    scores = {f"w{k}": drawn(k, 6, 0.5, 0.55, 0.8) for k in range(3)}
    study = judge(scores, margin=0.3)
    for name in ("p_different", "p_tied"):
        alone = [
            getattr(only(judge({"w": {k: scores[p.environment][k] for k in (p.first, p.second)}},
                               margin=0.3)), name)
            for p in study.pairs
        ]  # fmt: skip
        highest = 0.0
        for rank, place in enumerate(np.argsort(alone)):
            highest = max(highest, min(1, alone[place] * (9 - rank)))
            assert getattr(study.pairs[place], name) == pytest.approx(highest)


@pytest.mark.parametrize(("n", "most"), [(3, 7), (4, 99), (5, 1600)])
def test_equal_runs_do_not_prove_everything(n, most):
    """As many pairs of equal runs, and hardly more, are decided by n seeds."""

    def words(n_pairs):
        scores = {str(k): {"x": [1.0] * n, "y": [0.0] * n} for k in range(n_pairs)}
        return {pair.word for pair in judge(scores).pairs}

    assert words(most) == {"better"}
    assert words(math.ceil(most * 1.05) + 1) == {"undecided"}
    assert only(judge({"w": {"x": [1.0], "y": [0.0]}})).word == "undecided"


def test_an_agent_without_chance_is_known():
    other = [0.7, 0.8, 0.9, 0.8, 0.8]
    scores = {"w": {"plan": [1.0], "x": other}}
    assert only(judge(scores)).word == "undecided"
    pair = only(judge(scores, certain={("w", "plan")}))
    assert pair.p_different == pytest.approx(stats.ttest_1samp(other, 1.0).pvalue)
    both = judge({"w": {"plan": [1.0], "same": [0.99]}}, certain={("w", "plan"), ("w", "same")})
    assert (only(both).word, only(both).p_tied) == ("tied", 0.0)
    assert only(both).interval == pytest.approx((0.01, 0.01))


@pytest.mark.parametrize(
    ("n", "apart", "text", "best"),
    [
        (3, 0.5, "better so far", "x (so far)"),
        (5, 0.5, "better", "x"),
        (3, 0.0, "tied so far", "x, y (tied so far)"),
        (9, 0.0, "tied so far", "x, y (tied so far)"),
        (10, 0.0, "tied", "x, y (tied)"),
        (10, 0.019, "tied", "x, y (tied)"),
        (10, 0.021, "better", "x"),
        (1, 0.5, "undecided", "x, y (undecided)"),
    ],
)
def test_few_runs_say_so_far(n, apart, text, best):
    study = judge({"world": {"x": [0.5 + apart] * n, "y": [0.5] * n}})
    assert (only(study).text, str(study.best["world"])) == (text, best)


def test_what_lies_between_tied_agents_is_tied():
    # a and c are closer than the margin, and b lies between: ahead of c, behind a.
    scores = {"a": [0.518] * 10, "b": [0.5, 0.518] * 5, "c": [0.5] * 10}
    study = judge({"w": scores}, margin=0.0185)
    assert {pair.word for pair in study.pairs} == {"tied"}
    assert pair_of(study, "w", "a", "b").p_tied > 0.01  # by itself it is not shown
    assert pair_of(study, "w", "a", "b").p_different < 0.04


def test_better_than_better_is_better():
    # a is ahead of b, and b of c; c has too few runs beside a alone.
    rng = np.random.default_rng(0)
    scores = {"a": rng.normal(1, 0.1, 30), "b": rng.normal(0.8, 0.1, 30), "c": [0.5, 0.6, 0.1, 0.2]}
    words = {(p.first, p.second): p.word for p in judge({"w": scores}, margin=0).pairs}
    assert words == {("a", "b"): "better", ("b", "c"): "better", ("a", "c"): "better"}


def test_the_best_are_those_that_nobody_is_shown_to_beat():
    runs = np.random.default_rng(0).normal(0, 0.2, (4, 20))
    scores = {"low": runs[0], "high": runs[1] + 1, "near": runs[2] + 0.95, "gone": [NAN] * 20}
    best = judge({"w": scores}).best["w"]
    assert (set(best.agents), best.tied) == ({"high", "near"}, False)
    assert str(judge({"w": {"x": [1, 2]}}).best["w"]) == "x"
    assert str(judge({"w": {"x": [NAN]}}).best["w"]) == "none"


@pytest.mark.parametrize(
    ("others", "best"),
    [
        ({"y": 0.0}, "x, y (tied)"),
        ({"y": 0.0, "z": 0.0}, "x, y, z (tied with x)"),
        ({"y": 9.0, "z": 9.0}, "y, z (better than x)"),
        ({"y": 9.0, "z": 0.0}, "y, z (better than or tied with x)"),
        ({"y": 0.0, "z": [-9.0, 9.0] * 5}, "x, y, z (undecided)"),
    ],
)
def test_agents_that_are_compared_with_one_alone_stand_as_they_do_to_it(others, best):
    scores = {name: np.broadcast_to(runs, 10) for name, runs in {"x": 0.0, **others}.items()}
    assert str(judge({"w": scores}, margin=0.1, against="x").best["w"]) == best


def test_against_one_agent_only_its_pairs_are_tested():
    scores = drawn(0, 6, 0.5, 0.6, 0.7)
    study = judge({"w": scores}, against="a1", margin=0)
    assert [(p.first, p.second) for p in study.pairs] == [("a0", "a1"), ("a1", "a2")]
    alone = [
        stats.ttest_ind(scores[p.first], scores[p.second], equal_var=False).pvalue
        for p in study.pairs
    ]
    assert min(p.p_different for p in study.pairs) == pytest.approx(2 * min(alone))


SCORES = st.lists(st.sampled_from([0.0, 0.3, 0.5, 0.95, 0.99, 1.0, NAN]), min_size=10, max_size=10)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.lists(SCORES, min_size=2, max_size=4), min_size=1, max_size=3))
def test_words_never_contradict_each_other_or_their_intervals(table):
    scores = {f"w{k}": {f"a{j}": runs for j, runs in enumerate(w)} for k, w in enumerate(table)}
    study = judge(scores, bounds=(0, 1))
    for environment, runs in scores.items():
        both = [(a, b) for a in runs for b in runs if a != b]
        words = {names: pair_of(study, environment, *names).word for names in both}
        for (a, b), word in words.items():
            assert words[b, a] == {"better": "worse", "worse": "better"}.get(word, word)
            after = [c for c in runs if word == "better" and words.get((b, c)) == "better"]
            assert {words[a, c] for c in after} <= {"better", "tied"}
    for pair in study.pairs:
        low, high = pair.interval
        assert -1 <= low <= high <= 1
        fits = {"better": low >= 0, "worse": high <= 0, "tied": low >= -0.02 and high <= 0.02}
        assert fits.get(pair.word, True)
        assert pair.seeds_needed is None or pair.seeds_needed > pair.n
    for agent in study.agents:
        low, high = agent.mean_interval
        assert not agent.n or 0 <= low <= agent.mean <= high <= 1


def test_so_many_seeds_as_are_said_to_be_needed_decide():
    scores = drawn(3, 6, 0.5, 0.56)
    needed = only(judge({"w": scores}, margin=0)).seeds_needed

    def word_with(n):
        shape = stats.norm.ppf((np.arange(n) + 0.5) / n)
        shape /= shape.std(ddof=1)
        grown = {k: x.mean() + x.std(ddof=1) * shape for k, x in scores.items()}
        return only(judge({"w": grown}, margin=0)).word

    word = "worse" if scores["a0"].mean() < scores["a1"].mean() else "better"
    assert (word_with(needed), word_with(int(needed * 0.95))) == (word, "undecided")


def test_the_figures_of_an_agent():
    runs = [1.0, 0.9, 0.2, 0.95, 1.0, NAN]
    study = judge({"w": {"x": runs, "y": [0.8] * 6}}, bounds=(0, 1))
    x, y = study.agents
    assert (x.n, x.n_missing, x.mean, x.median) == (5, 1, pytest.approx(0.81), 0.95)
    low, _ = stats.t.interval(0.95, 4, 0.81, stats.sem(runs[:5]))  # whose upper end is cut
    assert (x.mean_interval, y.mean_interval) == ((pytest.approx(low), 1.0), (0.8, 0.8))
    assert study.failure_threshold["w"] == pytest.approx(0.95 / 2)
    exact = stats.binomtest(1, 5).proportion_ci(0.95, method="exact")
    assert (x.failed, x.failed_interval) == (1, pytest.approx((exact.low, exact.high)))
    unseen = [judge({"w": {"x": [1.0] * n}}).agents[0].unseen for n in (5, 10, 20, 30)]
    assert unseen == pytest.approx([0.451, 0.259, 0.139, 0.095], abs=5e-4)


def test_bounds_that_runs_contradict_leave_differences_in_their_intervals():
    scores = {"w": {"x": [3.0, 2.0, 4.0, 3.0, 2.5], "y": [0.5, 0.2, 0.1, 0.4, 0.3]}}
    low, high = only(judge(scores, bounds=(0, 1), margin=0)).interval
    assert low <= only(judge(scores, margin=0)).difference <= high


def test_failures_need_a_baseline_that_somebody_beats():
    for baseline, n_failed in ((0.0, 1), (None, None), (2.0, None)):
        study = judge({"w": {"x": [1.0, 0.4, 1.0]}}, baseline=baseline)
        assert study.agents[0].failed == n_failed


def test_arguments_out_of_range_are_named():
    for wrong in ({"level": 0.5}, {"level": 0.0}, {"n_looks": 0}, {"margin": -0.1}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            judge({"w": {"x": [1.0]}}, **wrong)


def test_looks_share_the_level_and_decided_pairs_keep_their_word():
    rng = np.random.default_rng(0)
    runs = {"good": rng.normal(1, 0.1, 40), "bad": rng.normal(0, 0.1, 40)}
    runs["near"] = rng.normal(0.97, 0.3, 40)
    looks = (10, 20, 40)
    first_runs = {"w": {name: x[:10] for name, x in runs.items()}}
    first = judge(first_runs, looks=looks, margin=0)
    assert (first.n_looks, first.is_done) == (1, False)
    assert first.seeds["w"] == {"good": 20, "bad": 10, "near": 20}  # bad is decided
    planned = judge(first_runs, n_looks=3, margin=0)
    assert first.pairs == planned.pairs
    once = dict(zip(planned.pairs, judge(first_runs, margin=0).pairs, strict=True))
    assert all(p.p_different == min(1, 3 * q.p_different) for p, q in once.items())
    shown = {name: x[: first.seeds["w"][name]] for name, x in runs.items()}
    second = judge({"w": shown}, looks=looks, margin=0)
    assert (second.n_looks, pair_of(second, "w", "good", "bad").n) == (2, 10)
    assert pair_of(second, "w", "good", "near").n == 20


def test_a_pair_counts_with_its_smallest_p_value():
    y = np.linspace(0, 1, 10)
    x = y + 0.2
    back = np.concatenate([y, 2 * x - y])  # the next ten bring the means together
    pair = only(judge({"w": {"x": np.tile(x, 2), "y": back}}, looks=(10, 20, 40), margin=0))
    assert pair.difference == pytest.approx(0, abs=1e-9)
    assert pair.p_different == pytest.approx(3 * stats.ttest_ind(x, y, equal_var=False).pvalue)


def test_a_study_ends_where_all_is_decided_or_no_seed_is_left():
    study = judge({"w": {"x": np.ones(80), "y": np.zeros(80)}}, looks=(10, 20, 40, 80))
    assert (study.n_looks, study.is_done, study.seeds["w"]) == (1, True, {"x": 10, "y": 10})
    x, y = np.random.default_rng(0).random((2, 80))
    study = judge({"w": {"x": x, "y": y}}, looks=(10, 20, 40, 80))
    assert (study.n_looks, study.is_done, only(study).n) == (4, True, 80)
    # An agent whose runs all crash gets no more.
    assert judge({"w": {"x": np.ones(10), "y": np.full(10, NAN)}}, looks=(10, 20)).is_done


@pytest.mark.parametrize("kind", ["different agents", "the same agent"])
@pytest.mark.parametrize("n_seeds", [5, 10])
def test_at_most_one_study_in_twenty_has_a_false_better_or_worse(kind, n_seeds, monkeypatch):
    """Studies drawn from the final scores of real runs, whose true means are known."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    from verdict_errors import WORDS, bank, falsity

    runs, words = bank()[kind].draw((1, 4), n_seeds, 200), []
    for scores in runs.scores[:, 0]:
        study = judge({"env": dict(zip("abcd", scores, strict=True))}, bounds=(-1, 1), margin=0.02)
        words.append([[WORDS[pair.word] for pair in study.pairs]])
    # At an error rate of 5 %, more are false with a probability of 0.0012 (binomial).
    assert falsity(np.array(words), runs)[0].any(axis=(1, 2)).sum() <= 20
    assert np.isin(words, (1, -1)).sum() > 200 or kind == "the same agent"  # words are given at all

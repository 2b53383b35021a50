"""Studies that grow until decided: by hand, against Holm's procedure, and open-ended."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from verdicts import (
    fewest_seeds,
    grow,
    judge_pairs,
    look_sizes,
)

SIZES = (6, 9, 14)
LEVEL = 0.045


def study(seed, n_agents=3, shift=1.0, n_seeds=SIZES[-1]):
    rng = np.random.default_rng(seed)
    return {
        str(k): np.round(rng.normal(size=n_seeds), 1) + shift * (k % 2) for k in range(n_agents)
    }


def cut(scores, seeds):
    return {name: values[: seeds[name]] for name, values in scores.items()}


def grown(scores, margin=0.5, certain=()):
    """As a study does it: seeds are there only after somebody was told to get them."""
    steps = [grow(cut(scores, dict.fromkeys(scores, 0)), SIZES, margin, LEVEL, certain)]
    while not steps[-1].is_done:
        steps.append(grow(cut(scores, steps[-1].seeds), SIZES, margin, LEVEL, certain))
    return steps


@pytest.mark.parametrize(
    ("first", "most", "n_agents", "sizes"),
    [
        (10, 50, 2, (10, 15, 22, 33, 50)),
        (10, 50, 5, (10, 15, 22, 33, 50)),
        (5, 50, 2, (6, 9, 14, 21, 33, 50)),  # 5 seeds cannot tell two agents apart in six looks
        (10, 11, 2, (10, 11)),
        (10, 10, 2, (10,)),
        (3, 6, 10, (6,)),
        (10, 50, 1, (10, 15, 22, 33, 50)),
    ],
)
def test_looks_are_evenly_apart_and_none_is_lost(first, most, n_agents, sizes):
    found = look_sizes(first, most, n_agents, LEVEL)
    assert found == sizes
    n_pairs = max(n_agents * (n_agents - 1) // 2, 1)
    assert found == (most,) or found[0] >= fewest_seeds(LEVEL / len(found), n_pairs)


@given(st.integers(1, 60), st.integers(1, 200), st.integers(1, 30))
def test_sizes_grow_from_the_first_to_the_most(first, most, n_agents):
    sizes = look_sizes(first, max(first, most), n_agents, LEVEL)
    assert sizes[-1] == max(first, most)
    assert sizes[0] >= first
    assert list(sizes) == sorted(set(sizes))


def test_who_is_told_from_all_others_gets_no_more_seeds():
    far, near = np.arange(14.0) + 100, np.tile([0.0, 1.0], 7)
    scores = {"far": far, "one": near, "other": near[::-1].copy()}
    first = grow(cut(scores, dict.fromkeys(scores, 9)), (9, 14), 0.0, LEVEL)
    assert (first.n_looks, first.is_done) == (1, False)
    assert first.seeds == {"far": 9, "one": 14, "other": 14}
    assert first.level == LEVEL / 2
    last = grow(cut(scores, first.seeds), (9, 14), 0.0, LEVEL)
    assert last.is_done
    assert last.looks == {("far", "one"): 1, ("far", "other"): 1, ("one", "other"): 2}
    assert [each.mean.verdict for each in last.judged.values()] == ["better", "better", "undecided"]


def test_against_one_agent_only_its_pairs_are_tested_and_grow():
    near = np.tile([0.0, 1.0], 7)
    scores = {"old": near, "far": np.arange(14.0) + 100, "near": near[::-1].copy()}
    scores["far too"] = scores["far"] + 0.5
    first = grow(cut(scores, dict.fromkeys(scores, 9)), (9, 14), 0.0, LEVEL, against="old")
    assert first.seeds == {"old": 14, "far": 9, "near": 14, "far too": 9}
    last = grow(cut(scores, first.seeds), (9, 14), 0.0, LEVEL, against="old")
    assert last.is_done
    said = {pair: each.mean.verdict for pair, each in last.judged.items()}
    assert said["old", "far"] == said["old", "far too"] == "worse"
    # The two that are far ahead are never compared, and nobody grows for them.
    assert said["far", "far too"] == said["old", "near"] == "undecided"
    assert (last.looks["old", "far"], last.looks["old", "near"]) == (1, 2)


def test_an_agent_whose_runs_fail_makes_nobody_grow():
    scores = {"fails": np.full(6, np.nan), "runs": np.arange(6.0)}
    found = grow(scores, SIZES, 0.0, LEVEL)
    assert (found.is_done, found.seeds) == (True, {"fails": 6, "runs": 6})
    assert found.judged["fails", "runs"].mean.verdict == "undecided"
    some = {"fails": np.array([np.nan, 1, 2, 3, 4, 5]), "runs": np.arange(6.0)}
    assert grow(some, SIZES, 0.0, LEVEL).seeds == {"fails": 9, "runs": 9}


def test_a_decided_pair_keeps_its_verdict():
    rng = np.random.default_rng(0)
    scores = {name: rng.normal(size=9) + shift for name, shift in [("a", 9), ("b", 0), ("c", 0.8)]}
    judged = judge_pairs(scores, 0.0, 0.05)
    decided = {pair: each for pair, each in judged.items() if each.is_decided}
    assert {("a", "b"), ("a", "c")} <= set(decided)
    found = judge_pairs(scores, 1.0, 0.05, (), decided)
    assert {pair: found[pair] for pair in decided} == decided


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.integers(2, 4), st.sampled_from([0.0, 0.5, 3.0]), st.booleans())
def test_a_study_grows_as_settled_and_comes_out_the_same_however_it_is_interrupted(
    seed, n_agents, margin, fails
):
    scores = study(seed, n_agents)
    if fails:
        scores["0"][::2] = np.nan
    steps = grown(scores, margin)
    for before, after in pairwise(steps):
        # No agent has more than was settled, or fewer than before.
        assert set(after.seeds.values()) <= set(SIZES)
        assert all(after.seeds[name] >= n for name, n in before.seeds.items())
        # What was decided stays, and only agents in other pairs grow.
        for pair, judgement in before.judged.items():
            if judgement.is_decided:
                assert after.judged[pair] == judgement
                assert after.looks[pair] == before.looks[pair]
        undecided = {p for p, each in after.judged.items() if not each.is_decided}
        grew = {name for name, n in after.seeds.items() if n > before.seeds[name]}
        assert grew <= {name for pair in undecided for name in pair}
    # Seeds that nobody asked for change nothing.
    assert grow(scores, SIZES, margin, LEVEL) == steps[-1]
    undecided = [p for p, each in steps[-1].judged.items() if not each.is_decided]
    for pair in undecided:
        enough = all(np.isfinite(scores[n][: steps[-1].seeds[n]]).sum() >= 5 for n in pair)
        assert not enough or all(steps[-1].seeds[name] == SIZES[-1] for name in pair)


def test_a_study_that_grows_until_decided_is_rarely_wrong():
    """Three times the same agent; 5 % and three standard deviations of so many studies."""
    rng, studies, sizes = np.random.default_rng(7), 200, (9, 14, 20)
    wrong = 0
    for _ in range(studies):
        tied = rng.choice([0.0, 0.9, 1.0], size=(3, sizes[-1]), p=[0.1, 0.3, 0.6])
        scores = {str(k): row for k, row in enumerate(tied)}
        judged = grow(scores, sizes, 0.0, 0.05).judged.values()
        wrong += any(
            each.mean.verdict in {"better", "worse"} and not each.mean.is_conditional
            for each in judged
        )
    assert wrong / studies <= 0.05 + 3 * (0.05 * 0.95 / studies) ** 0.5

"""Verdicts on studies drawn from the final scores of real runs, whose true means are known."""

from functools import cache
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from rl_yardstick.verdicts import judge

BANK = Path(__file__).parents[2] / "benchmarks" / "verdict_bank.npz"
MARGIN = 0.02
N_STUDIES = 200
# At an error rate of 5 %, more of 200 studies are false with a probability of 0.0012 (binomial).
MOST_FALSE = 20
KINDS = ("different agents", "the same agent")


@cache
def studies(kind, n_seeds):
    """Studies of one environment, and the true means of their agents."""
    rng = np.random.default_rng(n_seeds)
    with np.load(BANK) as stored:
        bank = {name: stored[name].astype(float) for name in stored.files}
    by_env = {}
    for name in bank:
        by_env.setdefault(name.partition("|")[0], []).append(name)
    large = [names for names in by_env.values() if len(names) >= 4]
    varying = [name for name, scores in bank.items() if np.ptp(scores) > 0]
    found = []
    for _ in range(N_STUDIES):
        if kind == "the same agent":
            chosen = [rng.choice(varying)] * 4
        else:
            chosen = rng.permutation(large[rng.integers(len(large))])[:4]
        runs = {
            letter: rng.choice(bank[k], n_seeds) for letter, k in zip("abcd", chosen, strict=True)
        }
        study = judge({"env": runs}, bounds=(-1.0, 1.0), margin=MARGIN)
        found.append((study, {a: bank[k].mean() for a, k in zip("abcd", chosen, strict=True)}))
    return found


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n_seeds", [5, 10])
def test_at_most_one_study_in_twenty_has_a_false_better_or_worse(kind, n_seeds):
    n_false = n_given = 0
    for study, mean in studies(kind, n_seeds):
        signs = {"better": 1, "worse": -1}
        said = [pair for pair in study.pairs if pair.word in signs]
        n_given += len(said)
        n_false += any(signs[p.word] * (mean[p.first] - mean[p.second]) <= 0 for p in said)
    assert n_false <= MOST_FALSE
    assert n_given > N_STUDIES or kind == "the same agent"  # words are given at all


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n_seeds", [5, 10])
def test_intervals_never_contradict_their_words(kind, n_seeds):
    for study, _ in studies(kind, n_seeds):
        for pair in study.pairs:
            low, high = pair.interval
            assert low <= pair.difference <= high
            assert {
                "better": low >= 0,
                "worse": high <= 0,
                "tied": low >= -MARGIN and high <= MARGIN,
                "undecided": low <= 0 <= high,
            }[pair.word]


@pytest.mark.parametrize("n_seeds", [5, 10])
def test_an_agent_better_than_a_better_one_is_better(n_seeds):
    n_chains = 0
    for study, _ in studies("different agents", n_seeds):
        ahead = {(p.first, p.second) for p in study.pairs if p.word == "better"}
        ahead |= {(p.second, p.first) for p in study.pairs if p.word == "worse"}
        for a, b, c in permutations("abcd", 3):
            if {(a, b), (b, c)} <= ahead:
                n_chains += 1
                assert (a, c) in ahead
    assert n_chains > 10

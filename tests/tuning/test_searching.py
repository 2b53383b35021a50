"""Searches over a toy: what is tried, ended early, tested again, and what a kill changes."""

import errno
import math
import os
import statistics
from dataclasses import replace

import numpy as np
import optuna
import pandas as pd
import pytest
from rl_yardstick.pipeline.settings.hyperparams import read_hyperparams, seeds_tuned_on
from rl_yardstick.tuning.trial_storage import FAILURE, FIGURES, SETTINGS

from rl_yardstick.experiments.analysis import analyse
from rl_yardstick.experiments.growing import looked
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.results import (
    CURVE_COLUMNS,
    RUN_COLUMNS,
    Curve,
    RunResults,
    StudyResults,
)
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.tuning import retesting, searching
from rl_yardstick.tuning.pruning import PRUNERS, is_hopeless
from rl_yardstick.tuning.retesting import (
    Candidate,
    Outcome,
    Retested,
    best_trials,
    chosen_for_retest,
    concluded,
    entry_text,
    is_settled,
    retest_study,
    write_winner,
)
from rl_yardstick.tuning.searching import RunOutcome, outcome_of
from rl_yardstick.tuning.tuning_spec import judged
from rl_yardstick.verdicts import Estimate

optuna.logging.set_verbosity(optuna.logging.ERROR)


def test_each_trial_is_the_mean_of_its_seeds_and_the_first_has_the_shipped_settings(
    toy, tmp_path, monkeypatch
):
    place = toy.opened(toy.tuning(), tmp_path)
    launcher = toy.search(place, toy.Launcher())
    assert len(launcher.done) == 30
    for trial in place.queue.trials():
        entry = trial.user_attrs[SETTINGS]
        assert trial.value == pytest.approx(np.mean([toy.score(entry, seed) for seed in range(3)]))
        assert set(trial.user_attrs[FIGURES]) == {"0", "1", "2"}
    assert place.queue.trials()[0].user_attrs[SETTINGS] == toy.shipped


@pytest.mark.parametrize(("sampler", "stops_after"), [("tpe", 29), ("gp", 14)])
def test_what_was_broken_off_goes_on_to_the_same_trials(toy, tmp_path, sampler, stops_after):
    tuning = toy.tuning(sampler=sampler)
    whole = toy.opened(tuning, tmp_path / "whole")
    toy.search(whole, toy.Launcher())
    first = toy.opened(tuning, tmp_path / "broken")
    toy.search(first, toy.Launcher(stops_after=stops_after))
    assert "RUNNING" not in toy.states(first)
    again = toy.opened(tuning, tmp_path / "broken")
    rest = toy.search(again, toy.Launcher())
    assert toy.states(again) == ["COMPLETE"] * 10
    assert toy.params(again) == toy.params(whole)
    assert len(rest.done) == 30 - stops_after


def test_a_hopeless_trial_is_ended_and_its_other_seeds_are_not_run(toy, tmp_path):
    place = toy.opened(toy.tuning(pruner="median", n_trials=20, n_seeds=5), tmp_path)
    launcher = toy.search(place, toy.Launcher())
    ended = [trial for trial in place.queue.trials() if trial.state.name == "PRUNED"]
    assert ended
    assert all(len(trial.user_attrs[FIGURES]) < 5 for trial in ended)
    assert len(launcher.done) == sum(len(t.user_attrs[FIGURES]) for t in place.queue.trials())


def at_once(entry, seed):
    """The optimum, but for a setting that did not learn on one seed."""
    return 0.0 if entry["gamma"] < 0.7 and seed == 2 else 1.0


def steps(entry, seed):
    return 1000 * entry["learning_rate"] + seed


@pytest.mark.parametrize(("retest", "n"), [(3, 10), (12, 12)])
def test_a_saturated_search_ends_and_ranks_by_steps_to_the_threshold(toy, tmp_path, retest, n):
    tuning = toy.tuning(n_trials=40, sampler="random", retest=retest)
    place = toy.opened(tuning, tmp_path)
    toy.search(place, toy.Launcher(), at_once, steps=steps)
    ended = [trial for trial in place.queue.trials() if trial.state.is_finished()]
    optimal = [t for t in ended if t.user_attrs[SETTINGS]["gamma"] >= 0.7]
    assert (place.n_at_optimum, len(optimal), optimal[-1] == ended[-1]) == (n, n, True)
    assert toy.states(place)[len(ended) :] == ["WAITING"] * (40 - len(ended))
    ranked = best_trials(place.queue.trials(), is_cost=False)
    rates = [each.entry["learning_rate"] for each in ranked]
    assert rates[:n] == sorted(rates[:n])
    assert [each.steps for each in ranked[:n]] == pytest.approx([1000 * r + 1 for r in rates[:n]])
    assert [each.steps for each in ranked[n:]] == [None] * (len(ended) - n)
    assert not toy.search(toy.opened(tuning, tmp_path), toy.Launcher(), at_once, steps=steps).done


def test_a_full_disk_says_nothing_of_settings(toy, tmp_path, monkeypatch):
    def full(**_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    place = toy.opened(toy.tuning(), tmp_path)
    toy.search(place, toy.Launcher(stops_after=7))
    monkeypatch.setattr(searching.tempfile, "TemporaryFile", full)
    with pytest.raises(UserError, match="No space left on device: make room"):
        toy.search(place, toy.Launcher(failing={0, 1, 2}))
    assert set(toy.states(place)) == {"COMPLETE", "WAITING"}


def test_scores_are_not_compared_with_those_of_another_search_before(toy, tmp_path):
    """The optimum of an environment may be known since an update."""
    place = toy.opened(toy.tuning(), tmp_path)
    toy.search(place, toy.Launcher(stops_after=7), judged_by="final")
    with pytest.raises(UserError, match=r"judged by final, and now by score: --name NAME makes"):
        toy.search(place, toy.Launcher())
    assert toy.search(place, toy.Launcher(), judged_by="final").done
    assert toy.states(place) == ["COMPLETE"] * 10
    # Nor is another search under the same name gone on with.
    with pytest.raises(UserError, match=r"toy: the tuning there is another .*objective: 'mean'"):
        toy.opened(toy.tuning(objective="lower"), tmp_path)


def test_a_setting_that_fails_is_one_of_the_worst_and_the_search_goes_on(toy, tmp_path):
    place = toy.opened(toy.tuning(), tmp_path)

    class Fragile(toy.Launcher):
        def submit(self, planned):
            self.failing = {0, 1, 2} if planned.entry["gamma"] > 0.9 else ()
            return super().submit(planned)

    toy.search(place, Fragile())
    for trial in place.queue.trials():
        fails = trial.user_attrs[SETTINGS]["gamma"] > 0.9
        assert trial.state.name == ("PRUNED" if fails else "COMPLETE")
        assert (FAILURE in trial.user_attrs) == fails
    # Where nothing but failures comes of it, it ends and says why.
    place = toy.opened(toy.tuning(), tmp_path / "failing")
    with pytest.raises(UserError, match=r"all of the first 5 trials failed; seed \d: it broke"):
        toy.search(place, toy.Launcher(failing={0, 1, 2}))


def test_how_many_runs_there_are(toy, tmp_path):
    """None after the time is over; seeds side by side; more trials beside those that are there."""
    late = toy.opened(toy.tuning(n_trials=4), tmp_path)
    assert not toy.search(late, toy.Launcher(), deadline=-math.inf).done
    assert toy.states(late) == ["WAITING"] * 4
    assert len(toy.search(late, toy.Launcher(n_workers=3)).done) == 12
    more = toy.opened(toy.tuning(n_trials=6), tmp_path)
    assert len(toy.search(more, toy.Launcher()).done) == 6
    assert toy.states(more) == ["COMPLETE"] * 6


def test_what_the_user_fixes_is_not_searched(toy, tmp_path):
    place = toy.opened(toy.tuning(settings={"gamma": 0.9}), tmp_path)
    toy.search(place, toy.Launcher())
    assert place.suggestions.n_free == 1
    assert {p["gamma"] for p in toy.params(place)} == {0.9}
    assert len({p["learning_rate"] for p in toy.params(place)}) == 10


def test_a_grid_goes_through_every_point_once(toy, tmp_path):
    place = toy.opened(toy.tuning(sampler="grid", n_trials=12, figure="steps"), tmp_path / "it")
    toy.search(place, toy.Launcher(), lambda entry, seed: 100.0 * entry["gamma"])
    tried = {(p["learning_rate"], p["gamma"]) for p in toy.params(place)[1:]}
    assert len(toy.params(place)) == 10  # three values of each, and what was shipped
    assert len(tried) == 9
    assert {gamma for _, gamma in tried} == {0.5, 0.75, 1.0}
    assert place.study.best_value == 50.0  # a cost is made small
    with pytest.raises(UserError, match="4 settings with two values of each number"):
        toy.opened(toy.tuning(sampler="grid", n_trials=4), tmp_path / "too few")


# --- what a run and a setting are worth, worked out by hand ---------------------------------------


def test_values_of_a_setting_by_hand():
    values = [0.0, 1.0, 0.9, 0.8, 0.1]
    assert judged(values, "mean", is_cost=False) == pytest.approx(0.56)
    assert judged(values, "mean", is_cost=True) == pytest.approx(0.56)
    assert judged(values, "iqm", is_cost=False) == pytest.approx((0.1 + 0.8 + 0.9) / 3)
    assert judged(values, "lower", is_cost=False) == pytest.approx(0.1)
    assert judged(values, "lower", is_cost=True) == pytest.approx(0.9)


def outcome(toy, monkeypatch, figure, **row):
    figures = {"step": [10, 20, 30], "seconds": [0.5, 1.0, 1.5], "value": [0.0, 0.6, 0.4]}
    evaluations = Curve({}, {name: np.array(values) for name, values in figures.items()})
    row = {"seconds": 2.0, "n_timesteps": 30, "threshold": 0.5, **row}
    results = RunResults([row], [evaluations])
    monkeypatch.setattr(searching, "read_run", lambda *_: results)
    return outcome_of(toy.tuning(figure=figure), None)


# The figure, what the run came to, the figure of it, and steps where it had the optimum.
FIGURES_OF_RUNS = [
    ("score", {"score": 0.7, "final": 5.0}, 0.7, None),
    ("score", {"score": None, "final": 5.0}, 5.0, None),
    ("final", {"score": 0.7, "final": 5.0}, 5.0, None),
    ("regret", {"regret": 12.0}, 12.0, None),
    ("steps", {}, 20.0, None),
    ("seconds", {}, 1.0, None),
    ("steps", {"threshold": 0.9}, 60.0, None),  # never: two whole runs
    ("seconds", {"threshold": 0.9}, 4.0, None),
    # Only an optimal score has steps.
    ("score", {"score": 1.0}, 1.0, 20.0),
    ("score", {"score": 1 - 1e-8, "threshold": 0.9}, 1 - 1e-8, 60.0),
]


@pytest.mark.parametrize(("figure", "row", "value", "steps"), FIGURES_OF_RUNS)
def test_the_figure_of_a_run(toy, monkeypatch, figure, row, value, steps):
    found = outcome(toy, monkeypatch, figure, **row)
    assert (found.figure, found.seconds, found.steps) == (value, 2.0, steps)


# === what is ended early ==========================================================================


def scored(scores, first=0):
    return {first + number: score for number, score in enumerate(scores)}


@pytest.mark.parametrize("method", PRUNERS)
def test_the_first_trial_and_the_best_one_go_on_and_the_worst_of_many_does_not(method):
    assert not is_hopeless({}, [], method)
    assert not is_hopeless(scored([0.1, 0.1]), [], method)
    others = [scored([0.1 * n] * 12) for n in range(8)]
    assert not any(is_hopeless(scored([0.8] * n), others, method) for n in range(1, 12))
    better = [scored([0.5 + 0.05 * n] * 12) for n in range(8)]
    ended = [is_hopeless(scored([0.0] * n), better, method) for n in range(1, 12)]
    assert any(ended) is (method != "none")


TWO = [[0.9, 0.9, 1.0], [1.0, 0.2]]
FAILED = [[0.9, 0.9, 0.9], [1.0, 0.1]]
SHORT = [[0.9, 0.9]]
# Their means are 0.5, 0.4, 0.6 and 0.8, the median of which is 0.55.
FOUR = [[0.0, 1.0], [0.2, 0.6], [0.6, 0.6], [0.8, 0.8]]
FIVE = [[0.1 * n] for n in range(1, 6)]
WHOLE = [[0.1 * n] * 3 for n in range(1, 6)]
# A score of 10 has been seen: with that, any trial could still win.
NINE, TEN = ([[0.5] * n, [10.0]] for n in (9, 10))
WORSE = [0.4, 0.39, 0.38, 0.37]
RACE = [[0.9, 0.2, 0.8]]


@pytest.mark.parametrize(
    ("method", "scores", "others", "options", "hopeless"),
    [
        # What is left counts as perfect: 0.9 and twice 1.0 is more than 2.8, with 0.8 it is a draw.
        ("bound", [0.8], TWO, {}, False),
        ("bound", [1.0, 0.79], TWO, {}, True),
        # A trial under way is no measure.
        ("bound", [0.1], SHORT, {}, True),
        ("bound", [0.1], SHORT, {"n_seeds": 3}, False),
        # Perfect is the highest score that any trial has had.
        ("bound", [-115.0], [[-110.0, -110.0], [-100.0, -200.0]], {}, False),
        # Where the optimum is known nothing less is.
        ("bound", [0.6], [[0.7, 0.7, 0.7]], {"ceiling": 1.0}, False),
        ("bound", [0.05], [[0.7, 0.7, 0.7]], {"ceiling": 1.0}, True),
        # One failed seed of three sinks a mean, and no median.
        ("bound", [0.1], FAILED, {"value": statistics.median}, False),
        ("bound", [0.1, 0.1], FAILED, {"value": statistics.median}, True),
        # Nothing is concluded from one seed, or from three others.
        ("median", [0.5, 0.5], FOUR, {}, True),
        ("median", [0.6, 0.5], FOUR, {}, False),
        ("median", [0.0, 0.0], FOUR[1:], {}, False),
        # Of six, two go on; two seeds are between the rungs.
        ("halving", [0.45], FIVE, {}, False),
        ("halving", [0.35], FIVE, {}, True),
        ("halving", [0.0, 0.0, 0.0], [*WHOLE, [1.0] * 9], {}, True),
        # A paired t test sees a steady difference at two seeds.
        ("racing", [0.8, 0.1], RACE, {}, True),
        ("racing", [0.8, 0.2], RACE, {}, False),
        # t = -3 with one degree of freedom: p = 0.102, and hopeless is what is below 0.1.
        ("racing", [0.8, 0.0], RACE, {}, False),
        # The default takes ranks from ten seeds on.
        ("auto", WORSE, NINE, {}, False),
        ("auto", WORSE, TEN, {}, True),
    ],
)
def test_what_is_hopeless(method, scores, others, options, hopeless):
    found = is_hopeless(scored(scores), [scored(each) for each in others], method, **options)
    assert found is hopeless


# === what is tested again =========================================================================


def retested(number, held_out, verdict="undecided", in_search=0.9, n_runs=20, n_failed=0):
    label = f"trial {number}" if number else "shipped"
    interval = Estimate(held_out or 0.0, 0.5, 0.9, 20)
    n_runs = 0 if held_out is None else n_runs
    return Retested(label, number, in_search, held_out, interval, verdict, n_runs, n_failed)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"until_decided": True, "retest": 0}, "leave out --retest 0"),
        ({"until_decided": True, "objective": "iqm"}, "decides means of scores, returns"),
        ({"first_retest_seed": 2}, "seed 2 is one of the search and of the re-test"),
        # It may grow into the seeds of the search.
        ({"until_decided": True, "first_seed": 1079}, "seed 1079 is one of the search and of"),
    ],
)
def test_what_a_re_test_cannot_be(toy, changes, complaint):
    first = changes.pop("first_seed", 0)
    tuning = toy.tuning(**changes)
    with pytest.raises(UserError, match=complaint):
        replace(tuning, study=replace(tuning.study, first_seed=first)).check()
    toy.tuning(first_retest_seed=3).check()
    toy.tuning(first_retest_seed=2, retest=0).check()


def test_the_best_of_a_search_are_run_again_each_once(toy, tmp_path):
    place = toy.opened(toy.tuning(), tmp_path)
    toy.search(place, toy.Launcher())
    ranked = best_trials(place.queue.trials(), is_cost=False)
    assert [each.value for each in ranked] == sorted((e.value for e in ranked), reverse=True)
    twice = best_trials([*place.queue.trials(), *place.queue.trials()], is_cost=False)
    assert twice == ranked
    chosen = chosen_for_retest(ranked, 3, is_cost=False)
    assert len(chosen) == 3
    assert all(each.number for each in chosen)
    study = retest_study(place.tuning, tmp_path, chosen)
    assert list(study.seeds) == list(range(1000, 1020))
    assert [agent.label for agent in study.agents] == ["shipped", *[e.label for e in chosen]]
    for agent, each in zip(study.agents[1:], chosen, strict=True):
        assert read_hyperparams("qlearning", "FrozenLake-v1", agent.conf_file) == each.entry


@pytest.mark.parametrize(
    ("figures", "is_below"),
    [
        ((0.1, 0.2, 0.3), True),  # the means differ by 0.6, the standard error is 0.082
        ((0.6, 0.7, 0.8), False),  # by 0.1
        ((0.8, 0.8, 0.8), False),  # equal means
        ((1.1, 1.2, 1.3), False),
        ((0.1,), False),
    ],
)
def test_settings_clearly_below_the_shipped_ones_are_not_run_again(figures, is_below):
    def candidate(number, figures):
        return Candidate(number, {}, float(np.mean(figures)), figures)

    shipped, other = candidate(0, (0.7, 0.8, 0.9)), candidate(1, figures)
    assert chosen_for_retest([shipped, other], 3, is_cost=False) == [other][is_below:]
    assert chosen_for_retest([other], 3, is_cost=False) == [other]
    # Costs are mirrored.
    costs = [candidate(each.number, tuple(-f for f in each.figures)) for each in (shipped, other)]
    assert chosen_for_retest(costs, 3, is_cost=True) == costs[1:][is_below:]
    # Without spread, any difference counts.
    level, lower = candidate(0, (0.8, 0.8)), candidate(1, (0.79, 0.79))
    assert chosen_for_retest([level, lower], 3, is_cost=False) == []


ENTRY = {
    "policy": "MlpPolicy",
    "n_timesteps": 1000,
    "learning_rate": 3e-05,
    "policy_kwargs": {"net_arch": [64, 64], "activation_fn": "nn.ReLU"},
    "env_wrapper": [{"rl_yardstick.envs.wrappers.ScaleReward": {"scale": 0.1}}],
    "normalize": None,
}


def runs_of_retest(toy, root, runs, **changes):
    """A re-test whose runs ended so, by settings: its tuning, candidates, results and figures.

    A run is its score, or the score and the searched figure; None if it is missing.
    """
    tuning = toy.tuning(retest_seeds=len(runs["shipped"]), **changes)
    labels = [label for label in runs if label != "shipped"]
    found = [Candidate(int(label[-1]), ENTRY, 0.5, (0.5,)) for label in labels]
    study = retest_study(tuning, root, found)
    planned = plan(study, root)
    ended = {(r.agent, r.seed): runs[r.agent][r.seed - 1000] for r in planned}
    ends = {key: np.broadcast_to(end, 2) for key, end in ended.items() if end is not None}
    rows = [
        {"agent": agent, "environment": "FrozenLake-v1", "env_id": "FrozenLake-v1", "seed": seed}
        | {"final": score, "score": score, "optimum": 1.0, "baseline": 0.0, "exact": True}
        for (agent, seed), (score, _) in ends.items()
    ]
    tables = pd.DataFrame(rows, columns=RUN_COLUMNS), pd.DataFrame(columns=CURVE_COLUMNS)
    return tuning, found, StudyResults(study, root, *tables, tuple(planned)), ends


def re_tested(toy, root, monkeypatch, runs, **changes):
    """The outcome of such a re-test."""
    tuning, found, results, ends = runs_of_retest(toy, root, runs, **changes)
    monkeypatch.setattr(
        retesting,
        "outcome_of",
        lambda _, run: RunOutcome(float(ends[run.agent, run.seed][1]), 1.0, "score"),
    )
    return concluded(tuning, found, found, analyse(results))


HALF = [0.0, 1.0] * 10
# Their mean is 0.36, and three quarters of them lie below.
SKEWED = [0.2] * 16 + [1.0] * 4

WORDS = [
    (HALF, [1.0] * 20, "better"),
    ([0.95, 1.0] * 10, [1.0] * 20, "better"),
    ([1.0] * 20, HALF, "worse"),
    # Closer than the margin of 0.02.
    ([0.99, 1.0] * 10, [1.0] * 20, "tied"),
    # Below 0 counts as 0, in figures as in verdicts.
    ([-3.0] * 20, [-1.0] * 20, "tied"),
    ([0.0] * 4, [1.0] * 4, "better so far"),
]


@pytest.mark.parametrize(("shipped", "found", "word"), WORDS)
def test_who_is_better_on_average_wins(toy, tmp_path, monkeypatch, shipped, found, word):
    runs = {"shipped": shipped, "trial 1": found, "trial 2": shipped, "trial 3": found}
    outcome = re_tested(toy, tmp_path, monkeypatch, runs)
    assert [each.verdict for each in outcome.retested[1::2]] == [word] * 2
    assert (outcome.winner is not None) == word.startswith("better")
    for each in outcome.retested:
        assert each.interval.low <= each.held_out <= each.interval.high


BETTER, HIGHEST = [0.5] * 20, [0.0, 1.0] * 9 + [1.0] * 2
OLD, NEAR = [0.3, 0.4] * 10, [0.3, 0.45] * 10
GROWN = [
    (BETTER, NEAR, True),  # the other may be undecided
    (BETTER, HIGHEST, False),  # but not if it is ahead
    (OLD, NEAR, False),
    ([None, *BETTER[1:]], NEAR, False),
]


@pytest.mark.parametrize(("first", "second", "settled"), GROWN)
def test_a_re_test_has_grown_enough_when_its_best_setting_is_decided(
    toy, tmp_path, first, second, settled
):
    runs = {"shipped": OLD, "trial 1": first, "trial 2": second}
    _, _, results, _ = runs_of_retest(toy, tmp_path, runs)
    said = looked(results, (20, 40))
    words = {(pair.first, pair.second): pair.word for pair in said.pairs}
    expected = "undecided" if first == OLD else "worse"
    assert words == {("shipped", "trial 1"): expected, ("shipped", "trial 2"): "undecided"}
    assert is_settled(said) == settled


@pytest.mark.parametrize(
    ("changes", "shipped", "found", "word"),
    [
        # Words are on means, also if another statistic was searched.
        ({"objective": "lower"}, SKEWED, [0.36] * 20, "undecided"),
        # Both reach the optimum, one of them sooner.
        ({"figure": "steps"}, [(1.0, 900.0 + k) for k in range(20)], [(1.0, 500.0)] * 20, "better"),
        ({"figure": "steps"}, [(1.0, 5.0)] * 20, [(1.0, 4.0)] * 6 + [(1.0, 9.0)] * 14, "worse"),
        ({"figure": "seconds"}, [(1.0, 5.0)] * 4, [(1.0, 1.0)] * 4, "better so far"),
    ],
)
def test_the_verdict_is_about_what_was_searched_for(
    toy, tmp_path, monkeypatch, changes, shipped, found, word
):
    runs = {"shipped": shipped, "trial 1": found, "trial 2": shipped}
    outcome = re_tested(toy, tmp_path, monkeypatch, runs, **changes)
    same = outcome.retested[2].verdict
    assert [each.verdict for each in outcome.retested[:2]] == ["", word]
    assert same in ("undecided", "tied so far")
    assert bool(outcome.winner) == word.startswith("better")


def test_an_entry_is_read_as_it_was_with_the_seeds_that_it_has_seen(toy, tmp_path):
    """The search's own, and those that the settings it began with were tuned on: 0 to 9."""
    path = tmp_path / "entry.yml"
    path.write_text(entry_text(toy.tuning(n_seeds=12), ENTRY, ["found: somewhere"]))
    assert read_hyperparams("qlearning", "FrozenLake-v1", path) == ENTRY
    assert seeds_tuned_on("qlearning", "FrozenLake-v1", path) == (range(12),)
    assert "\n# found: somewhere\nFrozenLake-v1:\n  policy: MlpPolicy\n" in path.read_text()
    assert "    net_arch: [64, 64]\n" in path.read_text()


def test_the_file_of_the_winner_says_where_it_comes_from(toy, tmp_path):
    winner = retested(4, 0.85, "better", n_failed=3)
    outcome = Outcome((retested(0, 0.7, ""), winner), winner, 0.05, "", range(1000, 1020))
    path = write_winner(toy.tuning(), tmp_path, outcome, ENTRY, 10)
    said = " ".join(line[2:] for line in path.read_text().splitlines() if line.startswith("# "))
    assert "trial 4 of 10 (tpe), mean of score over the seeds 0 to 2: 0.9." in said
    assert "On the seeds 1000 to 1019, which the search has not seen: 0.85 (95 % interval" in said
    assert "0.5 to 0.9, 20 runs, 3 of them failed); the settings before, there: 0.7" in said
    assert said.endswith("Verdict on means: better.")

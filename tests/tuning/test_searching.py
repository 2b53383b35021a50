"""Searches over a toy: what is tried, ended early, tested again, and what a kill changes."""

import math
import statistics
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from optuna.trial import create_trial

from rl_yardstick.experiments.analysis import analyse, looked
from rl_yardstick.experiments.results import RunResults
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.settings import read_entry, read_yaml, seeds_tuned_on
from rl_yardstick.tuning import retesting, searching
from rl_yardstick.tuning.searching import RUNS, SETTINGS, RunOutcome, outcomes_of
from rl_yardstick.verdicts import Estimate, steps_to_threshold
from tests.experiments.test_growing import results_of

REAL_OUTCOME_OF, REAL_STORAGE = searching.outcome_of, searching.open_storage
TABLES = read_yaml(Path(__file__).with_name("searches.yml"))


def states(search):
    return [trial.state.name for trial in search.trials]


def params(search):
    return [trial.params for trial in search.trials]


def test_each_trial_is_the_mean_of_its_seeds_and_the_first_has_the_shipped_settings(toy):
    search = toy.opened()
    assert len(toy.search(search)) == 30
    for trial in search.trials:
        entry, runs = trial.user_attrs[SETTINGS], outcomes_of(trial)
        assert trial.value == pytest.approx(np.mean([toy.score(entry, seed) for seed in range(3)]))
        assert set(runs) == {0, 1, 2}
    assert search.trials[0].user_attrs[SETTINGS] == toy.shipped


def test_what_was_broken_off_goes_on_to_the_same_trials(toy):
    whole = toy.opened(name="whole")
    toy.search(whole)
    first = toy.opened(name="broken")
    toy.search(first, stops_after=29)
    assert states(first)[-1] == "RUNNING"
    again = toy.opened(name="broken")
    assert len(toy.search(again)) == 1
    assert states(again) == ["COMPLETE"] * 10
    assert params(again) == params(whole)


def test_a_hopeless_trial_is_ended_and_its_other_seeds_are_not_run(toy):
    search = toy.opened(toy.tuning(pruner="auto", n_trials=20, n_seeds=5))
    done = toy.search(search)
    ended = [trial for trial in search.trials if trial.state.name == "PRUNED"]
    assert ended
    assert all(len(outcomes_of(trial)) < 5 for trial in ended)
    assert len(done) == sum(len(outcomes_of(trial)) for trial in search.trials)


def at_once(entry, seed):
    """The optimum, but for a setting that did not learn on one seed."""
    return 0.0 if entry["gamma"] < 0.7 and seed == 2 else 1.0


def steps(entry, seed):
    return 1000 * entry["learning_rate"] + seed


@pytest.mark.parametrize(("retest", "n"), [(3, 10), (12, 12)])
def test_a_saturated_search_ends_and_ranks_by_steps_to_the_threshold(toy, retest, n):
    tuning, figures = toy.tuning(n_trials=40, sampler="random", retest=retest), (at_once, steps)
    search = toy.opened(tuning)
    toy.search(search, score=at_once, steps=steps)
    trials = search.trials
    optimal = [trial for trial in trials if trial.user_attrs[SETTINGS]["gamma"] >= 0.7]
    assert (search.n_at_optimum, len(optimal), optimal[-1] == trials[-1]) == (n, n, True)
    assert len(trials) < 40
    ranked = retesting.best_trials(tuning, trials)
    rates = [each.user_attrs[SETTINGS]["learning_rate"] for each in ranked]
    assert rates[:n] == sorted(rates[:n])
    assert not toy.search(toy.opened(tuning), score=figures[0], steps=figures[1])


def test_another_search_of_the_same_name_is_not_continued(toy):
    toy.opened()
    with pytest.raises(UserError, match=r"toy: the search there is another .*objective: 'mean'"):
        toy.opened(toy.tuning(objective="lower"))


def test_a_setting_that_fails_is_one_of_the_worst_and_the_search_goes_on(toy):
    search = toy.opened()
    toy.search(search, failing=lambda run: run.entry["gamma"] > 0.9)
    for trial in search.trials:
        fails = trial.user_attrs[SETTINGS]["gamma"] > 0.9
        assert trial.state.name == ("PRUNED" if fails else "COMPLETE")
        assert (searching.FAILURE in trial.user_attrs) == fails
    # Where nothing but failures comes of it, it ends and says why.
    with pytest.raises(UserError, match=r"all of the first 5 trials failed; seed \d: it broke"):
        toy.search(toy.opened(name="failing"), failing=lambda run: True)


def test_how_many_runs_there_are(toy):
    """None after the time is over; seeds side by side; more trials beside those that are there."""
    late = toy.opened(toy.tuning(n_trials=4))
    assert not toy.search(late, deadline=-math.inf)
    assert len(toy.search(late, n_workers=3)) == 12
    more = toy.opened(toy.tuning(n_trials=6))
    assert len(toy.search(more)) == 6
    assert states(more) == ["COMPLETE"] * 6


def test_trials_with_equal_settings_share_their_runs(toy):
    (toy.folder / "space.yml").write_text("default: {gamma: [0.9, 0.8]}")
    search = toy.opened(toy.tuning(sampler="random"))
    assert len(toy.search(search, n_workers=4)) == 6
    assert states(search) == ["COMPLETE"] * 10
    assert len(retesting.best_trials(search.tuning, search.trials)) == 2


def test_what_the_user_fixes_is_not_searched(toy):
    search = toy.opened(toy.tuning(settings={"gamma": 0.9}))
    toy.search(search)
    assert search.suggestions.n_free == 1
    assert {p["gamma"] for p in params(search)} == {0.9}
    assert len({p["learning_rate"] for p in params(search)}) == 10


def test_the_storage_keeps_the_search(toy, monkeypatch):
    monkeypatch.setattr(searching, "open_storage", REAL_STORAGE)
    tuning = toy.tuning(n_trials=2, n_seeds=1)
    search = toy.opened(tuning, "a {b} %20 c?d")
    toy.search(search)
    assert params(toy.opened(tuning, "a {b} %20 c?d")) == params(search)
    journal = search.root / "trials.log"
    journal.write_bytes(journal.read_bytes() + b'{"op_code":2,"wor')  # a kill during a write
    assert params(toy.opened(tuning, "a {b} %20 c?d")) == params(search)
    journal.write_bytes(b"no journal any more\n" * 100)
    with pytest.raises(UserError, match=r"trials\.log is damaged: "):
        toy.opened(tuning, "a {b} %20 c?d")


@pytest.mark.parametrize(("objective", "figure", "value"), TABLES["objectives"])
def test_values_of_a_setting_by_hand(toy, objective, figure, value):
    tuning = toy.tuning(objective=objective, figure=figure)
    assert tuning.value([0.0, 1.0, 0.9, 0.8, 0.1]) == pytest.approx(value)


@pytest.mark.parametrize(("figure", "row", "value", "steps"), TABLES["figures"])
def test_the_figure_of_a_run(toy, monkeypatch, figure, row, value, steps):
    row = {"seconds": 2.0, "n_timesteps": 30, "threshold": 0.5, **row}
    row["steps_to_threshold"] = steps_to_threshold([10, 20, 30], [0.0, 0.6, 0.4], row["threshold"])
    monkeypatch.setattr(searching, "read_run", lambda *_: RunResults([row]))
    found = REAL_OUTCOME_OF(toy.tuning(figure=figure), None)
    assert (found.figure, found.seconds, found.steps) == (value, 2.0, steps)


@pytest.mark.parametrize(("scores", "others", "options", "hopeless"), TABLES["hopeless"])
def test_what_is_hopeless(scores, others, options, hopeless):
    if "value" in options:
        options = {"value": statistics.median}
    found = searching.is_hopeless(
        dict(enumerate(scores)), [dict(enumerate(o)) for o in others], **options
    )
    assert found is hopeless


@pytest.mark.parametrize(("changes", "complaint"), TABLES["no_retests"])
def test_what_a_re_test_cannot_be(toy, changes, complaint):
    first = changes.pop("first_seed", 0)
    tuning = toy.tuning(**changes)
    with pytest.raises(UserError, match=complaint):
        replace(tuning, study=replace(tuning.study, first_seed=first)).check()
    toy.tuning(first_retest_seed=3).check()
    toy.tuning(first_retest_seed=2, retest=0).check()


def test_the_best_of_a_search_are_run_again_each_once(toy, tmp_path):
    search = toy.opened()
    toy.search(search)
    tuning = search.tuning
    ranked = retesting.best_trials(tuning, search.trials)
    values = [each.value for each in ranked]
    assert values == sorted(values, reverse=True)
    twice = retesting.best_trials(tuning, [*search.trials, *search.trials])
    assert [each.number for each in twice] == [each.number for each in ranked]
    chosen = retesting.chosen_for_retest(tuning, ranked)
    assert len(chosen) == 3
    assert all(each.number for each in chosen)
    study = retesting.retest_study(tuning, tmp_path, chosen)
    assert list(study.seeds) == list(range(1000, 1020))
    labels = ["shipped", *map(retesting.label_of, chosen)]
    assert [agent.label for agent in study.agents] == labels
    for agent, each in zip(study.agents[1:], chosen, strict=True):
        entry = read_entry("qlearning", "FrozenLake-v1", agent.conf_file)
        assert entry == each.user_attrs[SETTINGS]


def complete_trial(number, entry, figures):
    runs = {str(k): asdict(RunOutcome(figure, 1.0, "score")) for k, figure in enumerate(figures)}
    attributes = {SETTINGS: entry, RUNS: runs}
    trial = create_trial(value=float(np.mean(figures)), user_attrs=attributes)
    trial.number = number
    return trial


@pytest.mark.parametrize(("figures", "is_below"), TABLES["below"])
def test_settings_clearly_below_the_shipped_ones_are_not_run_again(toy, figures, is_below):
    def chosen(figure, *others):
        found = [complete_trial(n, {}, each) for n, each in enumerate(others) if each]
        kept = retesting.chosen_for_retest(toy.tuning(figure=figure), found)
        return [each.number for each in kept]

    shipped, there = (0.7, 0.8, 0.9), [1][is_below:]
    assert chosen("score", shipped, figures) == there
    assert chosen("score", None, figures) == [1]
    # Costs are mirrored.
    assert chosen("regret", *(tuple(-f for f in each) for each in (shipped, figures))) == there
    # Without spread, any difference counts.
    assert chosen("score", (0.8, 0.8), (0.79, 0.79)) == []


ENTRY = {
    "policy": "MlpPolicy",
    "n_timesteps": 1000,
    "learning_rate": 3e-05,
    "policy_kwargs": {"net_arch": [64, 64], "activation_fn": "nn.ReLU"},
    "env_wrapper": [{"rl_yardstick.envs.wrappers.ScaleReward": {"scale": 0.1}}],
}


def runs_of_retest(toy, root, runs, **changes):
    """A re-test whose runs came to such scores, by settings: its tuning, candidates and results."""
    tuning = toy.tuning(retest_seeds=len(runs["shipped"]), **changes)
    labels = [label for label in runs if label != "shipped"]
    found = [complete_trial(int(label[-1]), ENTRY, [0.5]) for label in labels]
    study = retesting.retest_study(tuning, root, found)
    ends = {label: [s if s is None else 100 * s for s in scores] for label, scores in runs.items()}
    return tuning, found, results_of(study, root, ends)


def re_tested(toy, root, monkeypatch, runs, figures=None, **changes):
    """The outcome of such a re-test, where the searched figures may be others than scores."""
    tuning, found, results = runs_of_retest(toy, root, runs, **changes)
    told = figures or runs
    outcome = lambda _, run: RunOutcome(told[run.agent][run.seed - 1000], 1.0, "score")  # noqa: E731
    monkeypatch.setattr(retesting, "outcome_of", outcome)
    return retesting.concluded(tuning, found, found, analyse(results))


HALF = [0.0, 1.0] * 10
# Their mean is 0.36, and three quarters of them lie below.
SKEWED = [0.2] * 16 + [1.0] * 4

WORDS = [
    (HALF, [1.0] * 20, "better"),
    ([1.0] * 20, HALF, "worse"),
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
    _, _, results = runs_of_retest(toy, tmp_path, runs)
    said = looked(results, (20, 40))
    words = {(pair.first, pair.second): pair.word for pair in said.pairs}
    expected = "undecided" if first == OLD else "worse"
    assert words == {("shipped", "trial 1"): expected, ("shipped", "trial 2"): "undecided"}
    assert retesting.is_settled(said) == settled


@pytest.mark.parametrize(
    ("changes", "shipped", "found", "word"),
    [
        # Words are on means, also if another statistic was searched.
        ({"objective": "lower"}, SKEWED, [0.36] * 20, "undecided"),
        # Both reach the optimum, one of them sooner.
        ({"figure": "steps"}, [900.0 + k for k in range(20)], [500.0] * 20, "better"),
        ({"figure": "steps"}, [5.0] * 20, [4.0] * 6 + [9.0] * 14, "worse"),
    ],
)
def test_the_verdict_is_about_what_was_searched_for(
    toy, tmp_path, monkeypatch, changes, shipped, found, word
):
    figures = {"shipped": shipped, "trial 1": found, "trial 2": shipped}
    runs = figures if "objective" in changes else dict.fromkeys(figures, [1.0] * 20)
    outcome = re_tested(toy, tmp_path, monkeypatch, runs, figures, **changes)
    same = outcome.retested[2].verdict
    assert [each.verdict for each in outcome.retested[:2]] == ["", word]
    assert same in ("undecided", "tied so far")
    assert bool(outcome.winner) == word.startswith("better")


def test_an_entry_is_read_as_it_was_with_the_seeds_that_it_has_seen(toy, tmp_path):
    """The search's own, and those that the settings it began with were tuned on: 0 to 9."""
    path, tuning = tmp_path / "found.yml", toy.tuning(n_seeds=12)
    shipped = replace(tuning.agent, conf_file=None)
    tuning = replace(tuning, study=replace(tuning.study, agents=(shipped,)))
    path.write_text(retesting.entry_text(tuning, ENTRY, "found: somewhere"))
    assert read_entry("qlearning", "FrozenLake-v1", path) == ENTRY
    assert seeds_tuned_on("qlearning", "FrozenLake-v1", path) == (range(10), range(12))
    assert "\n# found: somewhere\nFrozenLake-v1:\n  policy: MlpPolicy\n" in path.read_text()


def test_the_file_of_the_winner_says_where_it_comes_from(toy):
    search = toy.opened()
    toy.search(search)
    rows = ("shipped", 0, 0.7, ""), ("trial 4", 4, 0.85, "better")
    shipped, winner = (
        retesting.Retested(label, n, 0.9, mean, Estimate(mean, 0.5, 0.9, 20), verdict, 20, 0)
        for label, n, mean, verdict in rows
    )
    outcome = retesting.Outcome((shipped, winner), winner, "", 0.05, range(1000, 1020))
    path = retesting.write_winner(search, outcome)
    assert read_entry("qlearning", "FrozenLake-v1", path) == search.trials[4].user_attrs[SETTINGS]
    said = " ".join(line[2:] for line in path.read_text().splitlines() if line.startswith("# "))
    assert "trial 4 of 10 (tpe), mean of score over the seeds 0 to 2: 0.9." in said
    assert "On the seeds 1000 to 1019, which the search has not seen: 0.85 (20 runs)" in said
    assert "the settings before, there: 0.7" in said
    assert said.endswith("Verdict on means: better.")
    assert retesting.write_winner(search, replace(outcome, winner=None)) is None
    assert not path.exists()

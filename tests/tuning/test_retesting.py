"""The re-test: what is run again, what wins, and by how much the search was fooled."""

from dataclasses import replace

import pytest

from pipeline.errors import UserError
from pipeline.settings.hyperparams import read_hyperparams, seeds_tuned_on
from tuning.retesting import (
    Outcome,
    Retested,
    _winner,
    best_trials,
    chosen_for_retest,
    entry_text,
    optimism,
    retest_study,
    write_winner,
)
from verdicts import Estimate


def retested(number, held_out, verdict="undecided", in_search=0.9, n_runs=20, n_failed=0):
    label = f"trial {number}" if number else "shipped"
    interval = Estimate(held_out or 0.0, 0.5, 0.9, 20)
    n_runs = 0 if held_out is None else n_runs
    return Retested(label, number, in_search, held_out, interval, verdict, n_runs, n_failed)


def test_seeds_of_the_search_and_of_the_re_test_are_apart(toy):
    toy.tuning(first_retest_seed=3).check()
    toy.tuning(first_retest_seed=2, retest=0).check()
    with pytest.raises(UserError, match="seed 2 is one of the search and of the re-test"):
        toy.tuning(first_retest_seed=2).check()


@pytest.mark.parametrize(
    ("is_cost", "in_search", "held_out", "fooled_by"),
    [(False, 0.9, 0.7, 0.2), (False, 0.7, 0.9, -0.2), (True, 100.0, 130.0, 30.0)],
)
def test_optimism_is_how_much_better_it_looked_than_it_is(
    toy, is_cost, in_search, held_out, fooled_by
):
    tuning = toy.tuning(figure="steps" if is_cost else "score")
    best = retested(4, held_out, in_search=in_search)
    assert optimism(tuning, best) == pytest.approx(fooled_by)
    assert optimism(tuning, replace(best, held_out=None)) is None


@pytest.mark.parametrize(
    ("others", "figure", "winner"),
    [
        ([(1, 0.8, "undecided"), (2, 0.9, "better")], "score", 2),
        ([(1, 0.8, "better, as seen"), (2, 0.75, "better")], "score", 1),
        ([(1, 0.8, "undecided"), (2, 0.9, "undecided")], "score", None),
        ([(1, 0.7, "undecided"), (2, 0.6, "worse")], "score", None),  # no better than before
        ([(1, 0.7 + 1e-15, "equivalent")], "score", None),
        ([(1, 0.9, "worse")], "score", None),
        ([(1, None, "undecided")], "score", None),
        ([(1, 0.9, "better", 0.9, 19), (2, 0.8, "better")], "score", 2),  # a run of it failed
        ([(1, 0.9, "better", 0.9, 19)], "score", None),
        ([(1, 0.65, "better"), (2, 0.6, "better")], "steps", 2),
    ],
)
def test_what_wins_is_better_on_other_seeds_than_what_there_was(toy, others, figure, winner):
    found, reason = _winner(
        toy.tuning(figure=figure), [retested(0, 0.7, ""), *[retested(*each) for each in others]]
    )
    assert (found and found.number) == winner
    assert bool(reason) == (winner is None)


def test_the_best_of_a_search_are_run_again_each_once(toy, tmp_path):
    place = toy.opened(toy.tuning(), tmp_path)
    toy.search(place, toy.Launcher())
    ranked = best_trials(place.queue.trials(), is_cost=False)
    assert [each.value for each in ranked] == sorted((e.value for e in ranked), reverse=True)
    twice = best_trials([*place.queue.trials(), *place.queue.trials()], is_cost=False)
    assert twice == ranked
    chosen = chosen_for_retest(ranked, 3)
    assert len(chosen) == 3
    assert all(each.number for each in chosen)
    study = retest_study(place.tuning, tmp_path, chosen)
    assert list(study.seeds) == list(range(1000, 1020))
    assert [agent.label for agent in study.agents] == ["shipped", *[e.label for e in chosen]]
    for agent, each in zip(study.agents[1:], chosen, strict=True):
        assert read_hyperparams("qlearning", "FrozenLake-v1", agent.conf_file) == each.entry


ENTRY = {
    "policy": "MlpPolicy",
    "n_timesteps": 1000,
    "learning_rate": 3e-05,
    "policy_kwargs": {"net_arch": [64, 64], "activation_fn": "nn.ReLU"},
    "env_wrapper": [{"envs.wrappers.ScaleReward": {"scale": 0.1}}],
    "normalize": None,
}


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
    outcome = Outcome((retested(0, 0.7, ""), winner), winner, 0.05, "")
    path = write_winner(toy.tuning(), tmp_path, outcome, ENTRY, 10)
    said = " ".join(line[2:] for line in path.read_text().splitlines() if line.startswith("# "))
    assert "trial 4 of 10 (tpe), mean of score over the seeds 0 to 2: 0.9." in said
    assert "On the seeds 1000 to 1019, which the search has not seen: 0.85 (95 % interval" in said
    assert "0.5 to 0.9, 20 runs, 3 of them failed); the settings before, there: 0.7" in said
    assert said.endswith("Verdict: better.")

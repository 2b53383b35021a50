"""What suggests settings: the same for a trial, whoever asks; and CMA-ES without a pickle."""

import json

import numpy as np
import optuna
import pytest
from cmaes import CMA

from tuning.evolution import FIRST_SPREAD, GENERATION, EvolutionSampler
from tuning.samplers import make_sampler
from tuning.tuning_spec import SAMPLERS

optuna.logging.set_verbosity(optuna.logging.ERROR)


def asked(study, number):
    """The draws of the trial of a number, in a study that has those before it."""
    while len(study.trials) <= number:
        trial = study.ask()
        values = [trial.suggest_float(name, 0.0, 1.0) for name in "abc"]
        study.tell(trial, sum(values))
    return study.trials[number].params


def study_of(tuning):
    return optuna.create_study(sampler=make_sampler(tuning), direction="maximize")


@pytest.mark.parametrize("sampler", [name for name in SAMPLERS if name != "grid"])
def test_a_trial_is_drawn_by_its_number_and_the_seed(toy, sampler):
    tuning = toy.tuning(sampler=sampler)
    study = study_of(tuning)
    asked(study, 7)
    other = study_of(tuning)
    for trial in study.trials[:6]:
        other.add_trial(trial)  # as another driver finds them
    assert asked(other, 7) == asked(study, 7)
    assert len({json.dumps(trial.params) for trial in study.trials}) > 5
    assert asked(study_of(toy.tuning(sampler=sampler, seed=1)), 0) != asked(study, 0)


def test_what_the_strategy_has_learnt_is_worked_out_from_the_trials(toy):
    """Against the strategy itself, told the same draws."""
    study = optuna.create_study(sampler=EvolutionSampler(3, 0))
    study.add_trial(trial_at(0.2, 0.8))
    strategy = CMA(mean=np.full(2, 0.5), sigma=FIRST_SPREAD, bounds=np.tile([0.0, 1.0], (2, 1)))
    size = strategy.population_size
    for _ in range(3):
        told = []
        for _ in range(size):
            trial = study.ask()
            point = [
                trial.suggest_float("a", 0.0, 2.0),
                trial.suggest_float("b", 1e-3, 1.0, log=True),
            ]
            strategy.reseed_rng(3)
            share = strategy.ask()
            assert point == pytest.approx([2 * share[0], 10 ** (3 * share[1] - 3)])
            value = float(point[0] ** 2 + len(told))
            study.tell(trial, value)
            told.append((share, value))
        strategy.tell(told)
    kept = {key for trial in study.trials for key in trial.system_attrs}
    assert kept == {GENERATION}


def trial_at(a, b):
    return optuna.create_trial(
        params={"a": a, "b": b},
        distributions={
            "a": optuna.distributions.FloatDistribution(0.0, 2.0),
            "b": optuna.distributions.FloatDistribution(1e-3, 1.0, log=True),
        },
        value=1.0,
    )


def test_the_strategy_finds_what_chance_does_not(toy):
    def best(sampler):
        study = optuna.create_study(sampler=make_sampler(toy.tuning(sampler=sampler)))
        for _ in range(120):
            trial = study.ask()
            point = [trial.suggest_float(name, -1.0, 1.0) for name in "abcd"]
            point.append(trial.suggest_int("e", -5, 5) / 5)
            study.tell(trial, sum((x - 0.2) ** 2 for x in point))
        return study.best_value

    assert best("cmaes") < 0.05 < best("random")

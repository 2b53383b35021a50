"""A tuning that was made up, for its page as text and in a browser; and short films."""

import json

import pytest

from rl_yardstick.pipeline.run import Run
from rl_yardstick.pipeline.settings import read_spec
from rl_yardstick.report import films


@pytest.fixture(autouse=True)
def short_films(monkeypatch):
    """As long as those of the study that many tests share."""
    monkeypatch.setattr(films, "MAX_STEPS", 20)


@pytest.fixture(scope="session")
def watched(tmp_path_factory):
    """Trains an agent to be watched; the spec, and what was recorded."""
    from rl_yardstick.pipeline.training import train

    def done(env_id, algo, entry, **fields):
        common = {"seed": 1, "pictures": False, "watch_learning": "page.html"}
        spec = read_spec(algo, env_id, entry, **{**common, **fields})
        with Run(tmp_path_factory.mktemp("run")) as run:
            run.begin(spec, {}, "")
            return spec, train(spec, run).watch

    return done


SPACE = {
    "rate": ("Float", {"step": None, "low": 0.01, "high": 1.0, "log": True}),
    "kind": ("Categorical", {"choices": ["a", None, True]}),
    "steps": ("Int", {"step": 1, "low": 1, "high": 5, "log": False}),
}


@pytest.fixture
def tuning_trial():
    """Makes up a trial."""

    def trial(number, value, figures, state="complete", failure=None, **params):
        at = f"2026-01-01T00:{{:02d}}:{number % 60:02d}"
        more = {"tau": 1.0} if number == 2 else {}
        told = {"number": number, "state": state, "value": value, "failure": failure}
        told |= {"params": {"rate": 0.1, "kind": "a", "steps": 3} | params, "figures": figures}
        told |= {"settings": {"learning_rate": number, "gamma": 0.9, **more}}
        return told | {"seconds": 2.0 * len(figures), "began": at.format(0), "ended": at.format(1)}

    return trial


@pytest.fixture
def tuning_record(tuning_trial):
    """What a tuning wrote down, made up; distributions are as Optuna writes them."""
    space = {
        name: json.dumps({"name": f"{kind}Distribution", "attributes": attributes})
        for name, (kind, attributes) in SPACE.items()
    }
    interval = {"point": 0.5, "low": 0.4, "high": 0.6, "n": 4, "n_missing": 0}
    shipped = {"label": "shipped", "number": 0, "held_out": 0.5, "in_search": 0.6, "verdict": ""}
    shipped |= {"n_runs": 4, "n_failed": 1, "interval": interval}
    winner = shipped | {"label": "trial 2", "number": 2, "held_out": 0.7}
    winner |= {"verdict": "better so far"}
    asked = {"algo": "dqn", "env": "Toy-v0", "sampler": "tpe", "pruner": "auto"}
    retest = {"settings": [shipped, winner], "winner": "trial 2", "winner_file": "winner.yml"}
    record = {"name": "t", "command": "python tune.py <script>", "widened": ["rate"]}
    record |= {"figure": "score", "objective": "mean", "lower_is_better": False, "n_trials": 10}
    record |= {"n_at_optimum": 0, "seeds": [1, 0], "held_out_seeds": [1000, 1001]}
    return record | {
        "asked": {**asked, "search_space": space},
        "trials": [
            tuning_trial(0, 0.6, {"1": 0.6, "0": 0.6}),
            tuning_trial(1, -30.0, {"1": -30.0}, "pruned", rate=1.0),
            tuning_trial(2, 0.8, {"1": 0.8, "0": 0.8}, kind=None),
            tuning_trial(3, 0.7, {"1": 0.7, "0": 0.7}, steps=5),
            tuning_trial(4, None, {}, "pruned", failure="it broke"),
            tuning_trial(5, None, {}, "running"),
            tuning_trial(6, 0.75, {"1": 0.75}, "pruned", kind=True),
        ],
        "retest": {**retest, "reason": "", "optimism": 0.1},
    }

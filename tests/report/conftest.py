"""Agents to be watched, and short films."""

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

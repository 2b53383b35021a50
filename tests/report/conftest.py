"""Analyses made up by hand, so that what is drawn and printed can be worked out on paper."""

import json
import math
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from selenium import webdriver

from experiments.analysis import AgentAnalysis, EnvironmentAnalysis, StudyAnalysis
from experiments.results import CURVE_COLUMNS, RUN_COLUMNS, StudyResults
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from report import films
from tests.report.browsing import BROWSER, DRIVER, FLAGS
from verdicts import Estimate, PairComparison, Summary, ThresholdSummary


def estimate(point, low=None, high=None, n=4):
    """An estimate; with an interval from a tenth below the point to a fifth above by default."""
    low = point - 0.1 if low is None else low
    high = point + 0.2 if high is None else high
    return Estimate(point, low, high, n)


def agent_analysis(label, mean, **changes):
    """An agent whose figures are the mean plus 1, 2, 3 and so on, so that none is another."""
    figures = AgentAnalysis(
        agent=label,
        algo="qlearning",
        n_runs=4,
        n_missing=0,
        metric=Summary(estimate(mean), estimate(mean + 1), estimate(mean + 2)),
        score=Summary(estimate(mean / 100), estimate(mean / 50), estimate(mean / 25)),
        final=estimate(mean + 3),
        area=estimate(mean + 4),
        last_episodes=estimate(mean + 5),
        regret=estimate(mean + 6),
        steps_to_threshold=ThresholdSummary(estimate(mean + 7), estimate(0.75, 0.5, 0.9)),
        steps_to_stay=ThresholdSummary(estimate(mean + 10), estimate(0.75, 0.5, 0.9)),
        episodes_to_stay=ThresholdSummary(estimate(mean + 8), estimate(0.75, 0.5, 0.9)),
        success_rate=estimate(0.5, 0.25, 0.625),
        seconds=estimate(mean + 9),
    )
    return replace(figures, **changes)


def pair_of(first, second, verdict, difference=10.0, seeds_needed=None):
    """A verdict on two agents."""
    gap = estimate(difference, difference - 5, difference + 5)
    chance = estimate(0.5, 0.25, 0.75)
    return PairComparison(first, second, gap, 0.01, 0.02, chance, verdict, seeds_needed)


def environment_analysis(agents=(), label="lake", **changes):
    known = EnvironmentAnalysis(label, "Lake-v0", 100.0, 20.0, 96.0, 1.6, True, tuple(agents), ())
    return replace(known, **changes)


def study_of(labels, metric="final", places=("lake",), n_seeds=4):
    return StudySpec(
        "s",
        "S",
        tuple(AgentSpec(label, "qlearning", tuned=False) for label in labels),
        tuple(EnvironmentSpec(place, "FrozenLake-v1") for place in places),
        n_seeds=n_seeds,
        metric=metric,
    )


def study_analysis(environments, labels, root=None, pulls=None, overall=None, **fields):
    study = study_of(labels, places=[one.environment for one in environments], **fields)
    empty = pd.DataFrame(columns=RUN_COLUMNS), pd.DataFrame(columns=CURVE_COLUMNS)
    results = StudyResults(study, root, *empty, (), pulls or {})
    return StudyAnalysis(results, tuple(environments), overall)


@pytest.fixture
def made_up():
    """What makes an estimate, an agent, an environment, a study, and its analysis."""

    class MadeUp:
        estimate = staticmethod(estimate)
        agent = staticmethod(agent_analysis)
        environment = staticmethod(environment_analysis)
        study = staticmethod(study_of)
        pair = staticmethod(pair_of)
        analysis = staticmethod(study_analysis)
        nothing = Estimate(math.nan, math.nan, math.nan, 0)

    return MadeUp


@pytest.fixture(autouse=True)
def short_films(monkeypatch):
    """As long as those of the study that many tests share."""
    monkeypatch.setattr(films, "MAX_STEPS", 20)


@pytest.fixture
def axes():
    """Axes to draw on, as many as asked for."""
    from matplotlib.figure import Figure

    def make(n=1):
        return list(Figure().subplots(1, n, squeeze=False).flat)

    return make


class Drawn:
    """What Matplotlib's axes show: asked for in plain numbers."""

    def __init__(self, axes):
        from matplotlib.collections import PolyCollection
        from matplotlib.colors import to_hex

        self.axes = axes
        self.lines = [
            {
                "label": line.get_label() if not line.get_label().startswith("_") else None,
                "x": np.asarray(line.get_xdata(), dtype=float).tolist(),
                "y": np.asarray(line.get_ydata(), dtype=float).tolist(),
                "colour": to_hex(line.get_color()).upper(),
                "style": line.get_linestyle(),
                "marker": line.get_marker(),
            }
            for line in axes.get_lines()
        ]
        self.bands = [
            {
                "colour": to_hex(area.get_facecolor()[0]).upper(),
                "alpha": round(float(area.get_facecolor()[0][3]), 2),
                "ends": self._ends(area.get_paths()[0].vertices),
            }
            for area in axes.collections
            if isinstance(area, PolyCollection)
        ]
        legend = axes.get_legend()
        self.legend = None if legend is None else [text.get_text() for text in legend.get_texts()]
        # Long words go over several lines.
        self.title = axes.get_title(loc="left").replace("\n", " ")
        self.labels = tuple(x.replace("\n", " ") for x in (axes.get_xlabel(), axes.get_ylabel()))
        self.ends = [note.get_text() for note in axes.texts]

    @staticmethod
    def _ends(vertices):
        """Low and high end of an area at each x."""
        return {
            float(x): (
                float(vertices[vertices[:, 0] == x, 1].min()),
                float(vertices[vertices[:, 0] == x, 1].max()),
            )
            for x in np.unique(vertices[:, 0])
        }

    def line(self, label):
        (found,) = [line for line in self.lines if line["label"] == label]
        return found

    @property
    def names(self):
        """The lines that have a name, in the order in which they were drawn."""
        return [line["label"] for line in self.lines if line["label"] is not None]

    @property
    def shared_legend(self):
        """The names in the legend of the whole figure."""
        (legend,) = self.axes.figure.legends
        return [text.get_text().replace("\n", " ") for text in legend.get_texts()]


@pytest.fixture
def drawn():
    return Drawn


@pytest.fixture
def canvases(monkeypatch):
    """By file name, the axes of each figure as it was written; the files themselves are empty."""
    import report.figures as style

    seen = {}

    @contextmanager
    def named(path):
        path.touch()
        yield path

    def keep(canvas, form, file):
        seen[file.name.partition(".")[0]] = canvas.axes

    monkeypatch.setattr(style, "replacing", named)
    monkeypatch.setattr(style, "write", keep)
    return seen


# As Optuna writes them.
SEARCH_SPACE = {
    "rate": ("Float", {"step": None, "low": 0.01, "high": 1.0, "log": True}),
    "kind": ("Categorical", {"choices": ["a", None, True]}),
    "steps": ("Int", {"step": 1, "low": 1, "high": 5, "log": False}),
}


def made_up_trial(number, value, figures, state="complete", failure=None, **params):
    return {
        "number": number,
        "state": state,
        "value": value,
        "params": {"rate": 0.1, "kind": "a", "steps": 3} | params,
        "settings": {"learning_rate": number, "gamma": 0.9} | ({"tau": 1.0} if number == 2 else {}),
        "figures": figures,
        "seconds": 2.0 * len(figures),
        "failure": failure,
        "began": f"2026-01-01T00:00:{number % 60:02d}",
        "ended": f"2026-01-01T00:01:{number % 60:02d}",
    }


@pytest.fixture
def tuning_record():
    """What a tuning wrote down, made up."""
    retested = {"held_out": 0.5, "verdict": "", "in_search": 0.6, "number": 0}
    retested |= {"n_runs": 4, "n_failed": 1}
    interval = {"point": 0.5, "low": 0.4, "high": 0.6, "n": 4, "n_missing": 0}
    return {
        "name": "t",
        "command": "python tune.py <script>",
        "asked": {
            "algo": "dqn",
            "env": "Toy-v0",
            "sampler": "tpe",
            "pruner": "auto",
            "search_space": {
                name: json.dumps({"name": f"{kind}Distribution", "attributes": attributes})
                for name, (kind, attributes) in SEARCH_SPACE.items()
            },
        },
        "figure": "score",
        "objective": "mean",
        "lower_is_better": False,
        "n_trials": 10,
        "seeds": [1, 0],
        "held_out_seeds": [1000, 1001],
        "widened": ["rate"],
        "trials": [
            made_up_trial(0, 0.6, {"1": 0.6, "0": 0.6}),
            made_up_trial(1, -30.0, {"1": -30.0}, "pruned", rate=1.0),
            made_up_trial(2, 0.8, {"1": 0.8, "0": 0.8}, kind=None),
            made_up_trial(3, 0.7, {"1": 0.7, "0": 0.7}, steps=5),
            made_up_trial(4, None, {}, "pruned", failure="it broke"),
            made_up_trial(5, None, {}, "running"),
            made_up_trial(6, 0.75, {"1": 0.75}, "pruned", kind=True),
        ],
        "retest": {
            "settings": [
                {**retested, "label": "shipped", "interval": interval},
                {**retested, "label": "trial 2", "number": 2, "held_out": 0.7, "verdict": "better"}
                | {"interval": interval},
            ],
            "winner": "trial 2",
            "winner_file": "winner.yml",
            "reason": "",
            "optimism": 0.1,
        },
    }


@pytest.fixture
def tuning_trial():
    """Makes up a trial."""
    return made_up_trial


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    assert BROWSER is not None, "the report has to be tested in Chromium: install it"
    assert DRIVER is not None, "the report has to be tested in Chromium: install its chromedriver"
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()

"""The page that plays a training: its data, its size; and those of a study, done again and kept."""

import base64
import gzip
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from rl_yardstick.experiments.analysis import analyse
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.run import Stop
from rl_yardstick.report.page import learning
from rl_yardstick.report.page.frame import as_json
from rl_yardstick.report.page.learning import exactly, write_first_pages, write_learning_page
from tests.report.made_up import HOSTILE


@pytest.fixture
def page_of(tmp_path):
    """Writes a page from what was recorded; its data and its text."""

    def write(spec, watch, **changes):
        path = tmp_path / "page.html"
        write_learning_page(spec.changed(**changes), watch, path)
        text = path.read_text(encoding="utf-8")
        (packed,) = re.findall(r'<script type="text/plain" id="data">([^<]*)</script>', text)
        return json.loads(gzip.decompress(base64.b64decode(packed))), text

    return write


def test_the_data_are_what_was_recorded_to_the_last_digit(watched, page_of):
    values = np.array([0.1 + 0.2, 1e-300, -2.0, np.nan, np.inf, 123456789.123456789])
    expected = [0.30000000000000004, 1e-300, -2, None, "Infinity", 123456789.12345679]
    assert json.loads(as_json({"values": values}, exactly)) == {"values": expected}
    maps = {"env_kwargs": {"desc": ["S.G"]}, "train_env_kwargs": {"desc": ["S..", "#.G"]}}
    spec, watch = watched("Warehouse-v0", "qlearning", {"n_timesteps": 200, **maps})
    data, _ = page_of(spec, watch)
    assert data["kind"] == "steps"
    for name in ("td_error", "target"):
        assert data["moves"][name] == watch.rows()["moves"][name].tolist()
    assert data["changes"]["after"] == watch.rows()["changes"]["after"].tolist()
    assert data["tables"] == [{"name": "q_tables", "shape": [1, 6, 4], "fill": 0}]
    assert data["layout"]["rows"] == ["S..", "#.G"]  # the map of the training
    assert data["layout"]["moves"] == [[-1, 0], [1, 0], [0, -1], [0, 1]]
    assert (data["n_states"], len(data["actions"]), data["is_cut"]) == (6, 4, False)


def test_a_page_is_no_larger_than_three_megabytes(watched, page_of, monkeypatch):
    training = watched("Warehouse-v0", "qlearning", {"n_timesteps": 800})
    _, text = page_of(*training)
    assert len(text) < learning.MOST_BYTES
    monkeypatch.setattr(learning, "MOST_BYTES", len(text) - 8000)
    cut, shorter = page_of(*training)
    assert len(shorter) <= len(text) - 8000
    assert cut["is_cut"]
    said = r"a page has room for [\d,]+ steps, and ends before the first 3,000 episodes do"
    assert re.search(said, page_of(*training, watch_episodes=3000)[1])
    n_steps = len(cut["steps"]["timesteps"])
    assert re.search(rf"· steps 1 to {n_steps} of 800, \d+ whole episodes?<", shorter)
    assert 1 < n_steps < 800
    assert len(cut["moves"]["step"]) == n_steps
    assert max(cut["changes"]["step"]) < n_steps


def test_each_agent_that_learns_is_shown_once_and_kept(do_study, tmp_path, in_this_process):
    agents = (AgentSpec("Q-learning & co", "qlearning"), AgentSpec(HOSTILE, "random"))
    places = (EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1", {"n_timesteps": 300}),)
    analysis = analyse(do_study(StudySpec("small", "", agents, places, n_seeds=1), tmp_path))
    shown, hidden = write_first_pages(analysis, 1, Stop())
    assert (shown.agent, hidden.agent) == ("Q-learning & co", HOSTILE)
    assert (shown.seed, shown.place) == (0, "learning/Q-learning_co/FrozenLake-v1_1.html")
    assert shown.words.startswith("step by step, steps 1 to 300 of 300, ")
    page = tmp_path / shown.place
    text = page.read_text(encoding="utf-8")
    assert "<h1>Q-learning &amp; co on FrozenLake-v1</h1>" in text
    assert len(text.encode()) == shown.size < 3_000_000
    assert (hidden.place, hidden.size) == ("", 0)
    assert "random on FrozenLake-v1 has neither" in hidden.words
    # Again, a page that is there is kept.
    before = page.stat().st_mtime_ns
    assert write_first_pages(analysis, 1, Stop()) == [shown, hidden]
    assert page.stat().st_mtime_ns == before
    # What comes out otherwise is not shown.
    (run,) = [run for run in analysis.results.finished if run.agent == shown.agent]
    other = replace(run, spec=run.spec.changed(seed=7))
    results = replace(analysis.results, finished=(other,), root=tmp_path / "other")
    first, _ = write_first_pages(replace(analysis, results=results), 1, Stop())
    assert first.place == ""
    assert first.words.startswith("the agent came out differently than in the run")
    assert not list((tmp_path / "other").rglob("*.html"))

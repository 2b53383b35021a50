"""The page that plays a training: its data, its size; and those of a study, done again and kept."""

import base64
import gzip
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from rl_yardstick.experiments.child_processes import TaskFailedError
from rl_yardstick.pipeline.settings.hyperparams import split
from rl_yardstick.pipeline.train_spec import TrainSpec

from rl_yardstick.experiments.analysis import analyse
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.training import carry_out, prepare
from rl_yardstick.report.page import learning
from rl_yardstick.report.page.frame import as_json
from rl_yardstick.report.page.learning import exactly, write_first_pages, write_learning_page

HOSTILE = "</script><script>document.title='taken'</script>"


@pytest.fixture
def watch(tmp_path):
    """Trains and writes the page; its data, its text and the training."""

    def done(env_id="Warehouse-v0", algo="qlearning", n_timesteps=200, settings=(), **fields):
        entry = {"n_timesteps": n_timesteps, **dict(settings)}
        common = {"seed": 1, "verbose": 0, "pictures": False, "log_folder": tmp_path / "logs"}
        common |= {"watch_learning": tmp_path / "page.html", **fields}
        training = prepare(
            TrainSpec(algo, env_id, split(entry), entry, **common), Console(quiet=True), {}, ""
        )
        carry_out(training)
        return *again(training), training

    return done


def again(training, **changes):
    """The page, written from what was recorded."""
    path = training.spec.watch_learning
    write_learning_page(replace(training.spec, **changes), training.watch, path)
    text = path.read_text(encoding="utf-8")
    (packed,) = re.findall(r'<script type="text/plain" id="data">([^<]*)</script>', text)
    return json.loads(gzip.decompress(base64.b64decode(packed))), text


def test_the_data_are_what_was_recorded_to_the_last_digit(watch):
    values = np.array([0.1 + 0.2, 1e-300, -2.0, np.nan, np.inf, 123456789.123456789])
    assert json.loads(as_json({"values": values}, exactly)) == {
        "values": [0.30000000000000004, 1e-300, -2, None, "Infinity", 123456789.12345679]
    }
    maps = {"env_kwargs": {"desc": ["S.G"]}, "train_env_kwargs": {"desc": ["S..", "#.G"]}}
    data, _, training = watch(settings=maps)
    moves, changes = training.watch.moves.rows, training.watch.changes.rows
    assert data["kind"] == "steps"
    assert data["moves"]["td_error"] == moves["td_error"].tolist()
    assert data["moves"]["target"] == moves["target"].tolist()
    assert data["changes"]["after"] == changes["after"].tolist()
    assert data["tables"] == [{"name": "q_tables", "shape": [1, 6, 4], "fill": 0}]
    assert data["layout"]["rows"] == ["S..", "#.G"]  # the map of the training
    assert data["layout"]["moves"] == [[-1, 0], [1, 0], [0, -1], [0, 1]]
    assert (data["n_states"], len(data["actions"]), data["is_cut"]) == (6, 4, False)


def test_without_a_table_the_policy_in_every_state(watch):
    data, text, training = watch("FrozenLake-v1", "value_iteration", 128)
    assert (data["kind"], data["unit"], data["stride"]) == ("maps", "evaluation", 1)
    assert "from evaluation to evaluation" in text
    rows, moments = training.watch.moments.rows, data["moments"]
    assert moments["timesteps"] == rows["timesteps"].tolist()
    assert moments["timesteps"][0] == 0
    assert moments["actions"][-1] == rows["actions"][-1].tolist()
    assert moments["return"][-1] == rows["values"][-1][0] > 0.5
    assert set(moments["loss"]) == {None}
    # Where an episode has ended nothing is done.
    reachable = training.watch.evaluator.model.reachable
    assert [value is not None for value in moments["values"][0]] == reachable.tolist()
    # The beginning and the end are there without evaluations.
    data, _, training = watch("FrozenLake-v1", "value_iteration", 64, eval_freq=-1)
    assert data["moments"]["timesteps"] == [0, 64]


def test_a_page_is_no_larger_than_three_megabytes(watch, monkeypatch):
    _, text, training = watch(n_timesteps=800)
    path = training.spec.watch_learning
    assert len(text) < learning.MOST_BYTES
    smaller = len(text) - 8000
    monkeypatch.setattr(learning, "MOST_BYTES", smaller)
    cut, _ = again(training)
    assert path.stat().st_size <= smaller
    assert cut["is_cut"]
    _, text = again(training, watch_episodes=3000)
    said = r"a page has room for [\d,]+ steps, and ends before the first 3,000 episodes do"
    assert re.search(said, text)
    n_steps = len(cut["steps"]["timesteps"])
    assert re.search(
        rf"· steps {801 - n_steps} to 800 of 800, \d+ whole episodes?<", again(training)[1]
    )
    assert 1 < n_steps < 800
    assert len(cut["moves"]["step"]) == n_steps
    assert max(cut["changes"]["step"]) < n_steps


# --- those of a study -----------------------------------------------------------------------------


@pytest.fixture
def done(monkeypatch):
    """Writes the pages of a study, in this process; these by agent, and what was trained."""
    trained = []

    def supervise(function, planned, *args, clean_up, limits, shares_process):
        trained.append(planned.agent)
        try:
            return function(planned, *args)
        except UserError as error:
            raise TaskFailedError(str(error), "") from error
        finally:
            clean_up()

    # A child process would import all libraries for each of them.
    monkeypatch.setattr(learning, "supervise", supervise)

    def write(analysis):
        trained.clear()
        pages = write_first_pages(analysis, 1)
        return {page.agent: page for page in pages}, sorted(trained)

    return write


def test_each_agent_that_learns_is_shown_once_and_kept(done, do_study, tmp_path):
    agents = (AgentSpec("Q-learning & co", "qlearning"), AgentSpec(HOSTILE, "random"))
    places = (EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1", {"n_timesteps": 300}),)
    analysis = analyse(do_study(StudySpec("small", "", agents, places, n_seeds=1), tmp_path))
    pages, trained = done(analysis)
    assert ([*pages], trained) == (["Q-learning & co", HOSTILE], [HOSTILE, "Q-learning & co"])
    shown = pages["Q-learning & co"]
    assert (shown.seed, shown.place) == (0, "learning/Q-learning_co/FrozenLake-v1_1.html")
    assert shown.words.startswith("step by step, 300 steps, ")
    page = tmp_path / shown.place
    text = page.read_text(encoding="utf-8")
    assert "<h1>Q-learning &amp; co on FrozenLake-v1</h1>" in text
    assert len(text.encode()) == shown.size < 3_000_000
    assert (pages[HOSTILE].place, pages[HOSTILE].size) == ("", 0)
    assert "random on FrozenLake-v1 has neither" in pages[HOSTILE].words
    # Again, only what cannot be shown is tried.
    assert done(analysis) == (pages, [HOSTILE])
    page.write_text(text.replace("300 steps", "900 steps"), encoding="utf-8")
    assert done(analysis)[1] == sorted(["Q-learning & co", HOSTILE])
    assert page.read_text(encoding="utf-8") == text
    # What comes out otherwise is not shown.
    run = next(run for run in analysis.results.finished if run.agent == "Q-learning & co")
    other = replace(run, spec=replace(run.spec, seed=7))
    results = replace(analysis.results, finished=(other,), root=tmp_path / "other")
    pages, _ = done(replace(analysis, results=results))
    assert pages["Q-learning & co"].place == ""
    assert pages["Q-learning & co"].words.startswith(
        "the agent came out differently than in the run"
    )
    assert not list((tmp_path / "other").rglob("*.html"))

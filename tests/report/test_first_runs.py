"""The trainings of a study that its page lets play: done again, held against the runs, linked."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.child_processes import TaskFailedError
from experiments.results import difference
from pipeline.digests import DamagedFileError
from pipeline.errors import UserError
from report.page import learning, write_report
from report.page.frame import LearningPage, Report
from report.page.learning import _train_again, write_first_pages
from report.series import study_series

EPISODES = SimpleNamespace(steps=np.zeros(1), returns=np.zeros(1))
HOSTILE = "</script><script>document.title='taken'</script>"


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

    monkeypatch.setattr(learning, "supervise", supervise)

    def write(analysis):
        trained.clear()
        pages = write_first_pages(analysis, 1)
        return {page.agent: page for page in pages}, sorted(trained)

    return write


@pytest.fixture
def analysis(one_environment, tmp_path):
    """The same study, with nothing in the folder that pages are written to."""
    results = replace(one_environment.results, root=tmp_path)
    return replace(one_environment, results=results)


def test_each_agent_that_learns_is_shown_once_and_kept(done, analysis, tmp_path):
    pages, trained = done(analysis)
    agents = ["Q-learning & co", "sarsa", HOSTILE]
    assert ([*pages], trained) == (agents, sorted(agents))
    shown = pages["Q-learning & co"]
    assert (shown.seed, shown.place) == (0, "learning/Q-learning_co/FrozenLake-v1_1.html")
    assert shown.words.startswith("step by step, 2,000 steps, ")
    text = (tmp_path / shown.place).read_text(encoding="utf-8")
    assert "<h1>Q-learning &amp; co on FrozenLake-v1</h1>" in text
    assert len(text.encode()) == shown.size < 3_000_000
    assert (pages[HOSTILE].place, pages[HOSTILE].size) == ("", 0)
    assert "random on FrozenLake-v1 has neither" in pages[HOSTILE].words
    # Again, only what cannot be shown is tried.
    assert done(analysis) == (pages, [HOSTILE])
    page = tmp_path / shown.place
    page.write_text(text.replace("2,000", "9,000"), encoding="utf-8")
    assert done(analysis)[1] == sorted(["Q-learning & co", HOSTILE])
    assert page.read_text(encoding="utf-8") == text
    note = page.with_suffix(".json")
    for damaged in ("{", "[]", "{}", json.dumps({**json.loads(note.read_text()), "words": 3})):
        note.write_text(damaged)
        assert learning.kept_page(tmp_path, first_of(analysis)) is None


def first_of(analysis):
    return next(run for run in analysis.results.finished if run.agent == "Q-learning & co")


def test_what_comes_out_otherwise_is_not_shown(analysis, tmp_path):
    run = first_of(analysis)
    other = replace(run, spec=replace(run.spec, seed=7))
    page = tmp_path / "page.html"
    with pytest.raises(UserError, match="the agent came out otherwise than in the run"):
        _train_again(other, page, tmp_path / "runs")
    assert not page.exists()


def test_runs_are_held_against_each_other_to_the_last_bit(analysis, monkeypatch):
    one, other = (run.run for run in analysis.results.finished if run.agent == "sarsa")
    assert difference(one, one) == ""
    assert difference(one, other) == "the agent"
    monkeypatch.setattr("experiments.results._tensors", lambda run: {})
    assert difference(one, other) == "the episodes"
    monkeypatch.setattr("experiments.results.read_episodes", lambda run: EPISODES)
    assert difference(one, other) == "the evaluations"


def test_what_is_no_zip_is_damaged(analysis, monkeypatch):
    run = first_of(analysis).run
    monkeypatch.setattr("pipeline.digests.RecordedFiles.read", lambda *_: b"PK")
    with pytest.raises(DamagedFileError, match="is no whole zip"):
        difference(run, run)


def test_agents_without_a_run_of_their_own_are_named(done, made_up, tmp_path):
    agents = [made_up.agent("ucb", 1.0), made_up.agent("fails", 0.0)]
    analysis = made_up.analysis([made_up.environment(agents)], ["ucb", "fails"], tmp_path)
    batch = SimpleNamespace(
        agent="ucb", environment="lake", is_batch=True, is_finished=True, path=tmp_path
    )
    results = replace(analysis.results, planned=(batch,), finished=(batch,))
    pages, _ = done(replace(analysis, results=results))
    assert pages["ucb"].words == learning.BATCH
    assert pages["fails"].words == "no run of it has finished"


def test_the_section_links_what_there_is_and_escapes_what_it_says(report_study, tmp_path):
    series = study_series(report_study.analysis)
    plain = tmp_path / "plain.html"
    write_report(Report(series, "c"), plain)
    assert 'id="watching"' not in plain.read_text(encoding="utf-8")
    lake, warehouse = (one.environment for one in report_study.analysis.environments)
    pages = [
        LearningPage(HOSTILE, lake, 3, "learning/a b&'\"<i>/x#1?.html", "<b>words</b>", 1500),
        LearningPage("sarsa", warehouse, 3, "", "<b>reason</b>"),
    ]
    page = tmp_path / "page.html"
    write_report(Report(series, "c", learning=pages), page)
    text = page.read_text(encoding="utf-8")
    section = text[text.index('<section id="watching"') :]
    section = section[: section.index("</section>")]
    assert 'href="learning/a%20b%26%27%22%3Ci%3E/x%231%3F.html"' in section
    assert "&lt;b&gt;words&lt;/b&gt;, 2 KB" in section
    assert "No page: &lt;b&gt;reason&lt;/b&gt;" in section
    assert "<script>" not in section
    assert section.count("<a ") == 1
    grown = page.stat().st_size - plain.stat().st_size
    assert 0 < grown < 100_000

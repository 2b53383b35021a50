"""Studies on bandits as pictures and as a page."""

import base64
import gzip
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate

from experiments.analysis import analyse
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from report.figures import write_figures
from report.page import world_sections, write_report
from report.page.frame import Report
from report.series import belief, study_series

PLACES = (
    EnvironmentSpec("coins", "BernoulliBandit-v0", {"n_timesteps": 400}),
    EnvironmentSpec("segments", "SegmentBandit-v0", {"n_timesteps": 400}),
    EnvironmentSpec("testbed", "GaussianBandit-v0", {"n_timesteps": 400}),
)
AGENTS = (
    AgentSpec("<b>Thompson</b>", "thompson", tuned=False),
    AgentSpec("blind", "thompson", {"ignore_context": True}, tuned=False),
    AgentSpec("normal", "thompson", {"likelihood": "gaussian"}, tuned=False),
    AgentSpec("eager", "epsilon_greedy", {"exploration_initial_eps": 1.0}, tuned=False),
)


@pytest.fixture(scope="module")
def analysis(tmp_path_factory, do_study):
    """Agents for clicks on two bandits; the third knows one of them alone."""
    study = StudySpec("s", "S", AGENTS, PLACES[:2], n_seeds=4, metric="regret")
    return analyse(do_study(study, tmp_path_factory.mktemp("study")))


@pytest.fixture(scope="module")
def page(analysis):
    path = analysis.results.root / "report.html"
    write_report(Report(study_series(analysis), "compare.py s.yml"), path)
    return path.read_text(encoding="utf-8")


def data_of(page, name):
    """A section's data on each environment; None where it has none."""
    pattern = '<script type="text/plain" data-packed id="data-{}-{}">(.*?)</script>'
    found = [re.search(pattern.format(name, place), page) for place in range(2)]
    texts = [None if one is None else gzip.decompress(base64.b64decode(one[1])) for one in found]
    return [None if text is None else json.loads(text) for text in texts]


def test_the_page_has_pulls_and_no_empty_curves(page):
    anchors = re.findall(r'<section id="(\w+)"', page)
    assert anchors == ["verdict", "overview", "ranking", "bandits", "comparison", "settings"]
    assert 'id="data-curves' not in page
    # A batch's agents are gone: there is nobody to film, and no return of a final policy.
    assert "Final returns are" not in page
    assert 'aria-sort="ascending"' in page
    assert "a lower regret of a run is better" in page
    assert "<b>Thompson" not in page


def test_the_data_are_the_statistics(analysis, page):
    data = data_of(page, "bandits")
    for item, environment in zip(data, analysis.environments, strict=True):
        assert list(item["curves"]) == [agent.agent for agent in environment.agents]
        for label, curves in item["curves"].items():
            statistics = analysis.results.pulls[label, environment.environment]
            assert curves["x"] == statistics.pulls.tolist()
            regret = curves["regret"]
            assert regret["mean"]["y"] == pytest.approx(statistics.cumulative_regret, rel=1e-4)
            reach = 1.96 * statistics.cumulative_regret_sem
            high = statistics.cumulative_regret + reach
            assert regret["mean"]["high"] == pytest.approx(high, rel=1e-4)
            assert regret["runs"]["y"] == pytest.approx(
                statistics.cumulative_regret_quantiles[2], rel=1e-4
            )
            assert curves["simple"] == pytest.approx(statistics.simple_regret, rel=1e-4)
    coins, segments = data
    assert coins["best"] == 0.75
    assert segments["best"] == pytest.approx(0.159)
    assert segments["bounds"] is None
    assert coins["bounds"]["auer"][-1] == pytest.approx(46.545 * np.log(400) + 3.432, rel=1e-3)
    assert coins["bounds"]["lai_robbins"][0] == 0


def test_the_table_by_context(analysis):
    segments = analysis.results.pulls["blind", "segments"]
    tables = world_sections.context_tables({"blind": segments})
    assert [table["name"] for table in tables] == ["context 0", "context 1"]
    core, casual = tables
    assert [row["mean"] for row in core["rows"]] == [0.10, 0.25, 0.05]
    assert [row["regret"] for row in casual["rows"]] == pytest.approx([0, 0.06, 0.07])
    for context, table in enumerate(tables):
        shares = [row["shares"]["blind"] for row in table["rows"]]
        assert shares == pytest.approx(segments.shares[context])
        gaps = [row["regret"] for row in table["rows"]]
        assert table["regrets"]["blind"] == pytest.approx(np.dot(shares, gaps))
        # The same as what was summed up pull by pull.
        known = np.nan_to_num(segments.context_regret[context])
        assert table["regrets"]["blind"] == pytest.approx(segments.shares[context] @ known)
    (alone,) = world_sections.context_tables({"it": analysis.results.pulls["normal", "coins"]})
    assert alone["name"] == ""


def test_beliefs(analysis):
    results = analysis.results
    for agent, lowest in ((AGENTS[2], 0.2 - 2), (AGENTS[0], 0)):
        found = belief(results, agent.label, results.pulls[agent.label, "coins"])
        assert found.points[0] == pytest.approx(lowest)
        for y in found.densities[0, 0]:
            assert integrate.trapezoid(y, found.points) == pytest.approx(1, abs=0.02)
        assert found.true_means[0][2] == 0.75
    # What an agent believes of an arm over all contexts has no one true mean here.
    for label, mean in (("blind", None), (AGENTS[0].label, 0.25)):
        found = belief(results, label, results.pulls[label, "segments"])
        assert found.true_means[0][1] == mean


def test_posteriors_on_the_page(page):
    coins, segments = data_of(page, "bandits")
    assert {item["agent"] for item in coins["beliefs"]} == {a.label for a in AGENTS[:3]}
    by_agent = {item["agent"]: item for item in segments["beliefs"]}
    item = by_agent[AGENTS[0].label]
    assert item["moments"] == [10, 100, 400]
    assert np.shape(item["densities"]) == (3, 2, 3, len(item["points"]))
    assert item["true_means"] == [[0.10, 0.25, 0.05], [0.12, 0.06, 0.05]]
    assert np.shape(by_agent["blind"]["densities"])[1] == 1
    assert by_agent["blind"]["true_means"] == [[None] * 3]


def test_figures(analysis):
    study = replace(analysis.study, environments=PLACES[1:2])
    analysis = replace(
        analysis,
        results=replace(analysis.results, study=study),
        environments=analysis.environments[1:],
    )
    names = {
        path.name for path in write_figures(study_series(analysis), None) if path.suffix == ".png"
    }
    assert names == {
        *(f"segments_{kind}.png" for kind in ("pulls", "regret", "arms")),
        *(f"segments_{agent}_posteriors.png" for agent in ("b_Thompson_b", "blind", "normal")),
    }


def test_bandits_whose_arms_are_drawn_anew(tmp_path, do_study):
    """There are no arms to tell apart over runs, and no bounds; curves there are."""
    agents = (AGENTS[2], AGENTS[3])
    study = StudySpec("s", "S", agents, PLACES[2:], n_seeds=3, metric="regret")
    analysis = analyse(do_study(study, tmp_path))
    (item,) = world_sections.bandits(Report(study_series(analysis), "")).places
    assert item["best"] == pytest.approx(1.5388, abs=1e-4)
    assert (item["bounds"], item["arms"], item["beliefs"]) == (None, None, ())
    assert set(item["curves"]) == {"normal", "eager"}
    names = {path.stem for path in write_figures(study_series(analysis), None)}
    assert names == {"testbed_pulls", "testbed_regret"}


def test_a_parameter_is_drawn_by_its_values(tmp_path, do_study):
    agents = tuple(
        AgentSpec(
            f"epsilon={value}",
            "epsilon_greedy",
            {"exploration_initial_eps": value},
            tuned=False,
            group="epsilon-greedy",
            swept={"exploration_initial_eps": value},
        )
        for value in (0.05, 0.1, 0.2)
    )
    study = StudySpec("s", "S", agents, PLACES[:1], n_seeds=2, metric="training")
    names = {
        path.stem for path in write_figures(study_series(analyse(do_study(study, tmp_path))), None)
    }
    assert "coins_sweep" in names


def test_a_study_of_both_kinds(tmp_path, do_study):
    """Curves by step where there is no bandit, curves by pull where there is."""
    lake = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 200})
    coins = replace(PLACES[0], settings={"n_timesteps": 60})
    agents = (AgentSpec("qlearning", "qlearning", tuned=False),)
    study = StudySpec("s", "S", agents, (lake, coins), n_seeds=2)
    analysis = analyse(do_study(study, tmp_path))
    path = tmp_path / "report.html"
    write_report(Report(study_series(analysis), ""), path)
    page = path.read_text(encoding="utf-8")
    by_step, by_pull = data_of(page, "curves"), data_of(page, "bandits")
    assert [item is None for item in by_step] == [False, True]
    assert [item is None for item in by_pull] == [True, False]
    assert "This environment is a bandit" in page
    assert "This environment is no bandit" in page

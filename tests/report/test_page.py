"""The page of a study: what is on it, and that nothing can be put into it or drawn from outside."""

import base64
import gzip
import hashlib
import json
import math
import platform
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from plotly.offline import get_plotlyjs

from experiments.looks import Look, Looks, Question
from report.conclusions import conclusion, pairs_both_ways
from report.figures import line_style
from report.films import MAX_BYTES, MAX_SIDE, film_of
from report.page import SECTIONS, render, result_sections, world_sections, write_report
from report.page.frame import Report, breakable, inline_script, p_value, packed, plain, setting
from report.series import (
    COLOURS,
    Curve,
    EnvironmentSeries,
    Grid,
    StudySeries,
    Sweep,
    agent_marks,
    study_series,
)
from report.words import interval_alone
from verdicts import Estimate

HOSTILE = "</script><script>document.title='taken'</script>"

# Attributes that make a browser fetch something.
LOADING = {"src", "srcset", "data", "poster", "action", "formaction", "background", "ping"}
SECTION_NAMES = [
    "verdict",
    "overview",
    "ranking",
    "curves",
    "comparison",
    "overall",
    "policies",
    "films",
    "settings",
]


class Page(HTMLParser):
    """What a page holds: its elements with their attributes, and the text inside each."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.texts, self._open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self.texts.append("")
        self._open.append(len(self.texts) - 1)
        if tag in {"meta", "link", "img", "input", "br"}:
            self._open.pop()

    def handle_endtag(self, tag):
        while self._open and self.elements[self._open.pop()][0] != tag:
            pass

    def handle_data(self, data):
        for place in self._open:
            self.texts[place] += data

    def all(self, tag):
        """Attributes and text of each such element."""
        return [
            (attributes, text)
            for (name, attributes), text in zip(self.elements, self.texts, strict=True)
            if name == tag
        ]


@pytest.fixture(scope="module")
def text(report_study):
    return report_study.page.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def data_names(page):
    return [a["id"] for a, _ in page.all("script") if "data-packed" in a]


def data_of(page, name):
    found = [text for attributes, text in page.all("script") if attributes.get("id") == name]
    assert len(found) == 1
    return json.loads(gzip.decompress(base64.b64decode(found[0])))


# --- structure -----------------------------------------------------------------------------------


def test_the_sections_in_their_order(page):
    assert [attributes["id"] for attributes, _ in page.all("section")] == SECTION_NAMES
    assert len(SECTIONS) >= len(SECTION_NAMES)


def test_a_language_a_title_one_main_heading_and_a_heading_for_each_section(page):
    assert page.all("html")[0][0]["lang"] == "en"
    assert page.all("title")[0][1] == "Small & <b>bold</b>"
    assert [text for _, text in page.all("h1")] == ["Small & <b>bold</b>"]
    assert len(page.all("h2")) == len(SECTION_NAMES)
    labelled = {attributes["aria-labelledby"] for attributes, _ in page.all("section")}
    assert labelled == {attributes["id"] for attributes, _ in page.all("h2")}


def test_no_id_is_given_twice_and_all_links_lead_somewhere(page):
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert {attributes["href"][1:] for attributes, _ in page.all("a")} <= set(ids)


def test_the_verdict_comes_first_and_says_all_that_the_study_has_shown(page, report_study):
    verdict = page.all("section")[0][1]
    analysis = report_study.analysis
    said = [conclusion(analysis.study, place) for place in analysis.environments]
    expected = [sentence for one in said for sentence in one.everything]
    assert len(expected) >= 3
    assert [sentence for sentence in expected if sentence not in verdict] == []


def test_the_ranking_holds_every_agent_of_every_environment_best_first(page, report_study):
    tables = page.all("table")
    rankings = [text for attributes, text in tables if attributes.get("class") == "sortable"]
    for environment, table in zip(report_study.analysis.environments, rankings, strict=False):
        places = [table.index(agent.agent) for agent in environment.agents]
        assert places == sorted(places)
        assert len(places) == 3


def test_sorted_columns_say_so(page):
    sorted_headings = [a["aria-sort"] for a, _ in page.all("th") if "aria-sort" in a]
    assert sorted_headings == ["descending"] * 2  # the ranking of each environment


def test_every_figure_has_a_caption_and_every_plot_a_description(page):
    assert len(page.all("figcaption")) == len(page.all("figure"))
    plots = [a for a, _ in page.all("div") if "plot" in a.get("class", "").split()]
    assert len(plots) == 4
    assert all(a["role"] == "img" and len(a["aria-label"]) > 20 for a in plots)


def test_settings_command_versions_and_failures(page, report_study):
    settings = page.all("section")[-1][1]
    assert "python compare.py 'a & b.yml'" in settings
    assert "Seeds: 0 to 1." in settings
    assert "Seeds 0 to 1: the shipped settings of" in settings
    assert "2,000" in settings  # steps run
    assert "gamma" in settings
    assert report_study.planned[0].run.read_info()["versions"]["numpy"] in settings
    machine = report_study.planned[0].run.read_info()["machine"]
    assert machine["processor"] in settings
    assert f"cores{machine['cores']}" in settings.replace("\n", "")
    assert platform.node() not in "".join(machine.values())
    assert "looked at" not in settings  # nobody has, by the file
    assert re.search(r"on Warehouse-v0, seed 1:\s+ValueError: <the> disk & all is full", settings)


def test_settings_have_the_looks_and_of_old_runs_no_machine(report_study, tmp_path, monkeypatch):
    question = Question("final", None, None, 5)
    look = Look("2026-11-22 10:00:00", question, {"a": 4, "b": 4}, {}, {}, 0.045, planned=False)
    looks = {"Warehouse-v0": Looks((look,))}
    monkeypatch.setattr(result_sections, "read_looks", lambda _: looks)
    infos = [{"versions": {"numpy": "2"}}]
    assert result_sections.recorded("machine", infos) == {}
    write_report(Report(study_series(report_study.analysis), "compare.py"), tmp_path / "page.html")
    settings = Page((tmp_path / "page.html").read_text(encoding="utf-8")).all("section")[-1][1]
    assert "These runs have been looked at once." in settings
    assert "2026-11-22: seeds 5 to 8; claims at 4.5 %." in settings
    assert "None on this environment: too few runs." in settings


def test_a_study_on_one_environment_compares_nothing_over_environments(one_environment, tmp_path):
    write_report(
        Report(study_series(one_environment), "python compare.py x.yml"), tmp_path / "page.html"
    )
    page = Page((tmp_path / "page.html").read_text(encoding="utf-8"))
    names = [attributes["id"] for attributes, _ in page.all("section")]
    assert names == [name for name in SECTION_NAMES if name not in {"overview", "overall"}]
    assert not [a for a, _ in page.all("select") if a.get("id") == "environment"]


# --- data of the figures -------------------------------------------------------------------------


def test_the_curves_end_with_the_final_evaluations(page, report_study):
    curves = data_of(page, "data-curves-0")["evaluation"]["by_axis"]["step"]
    summary = report_study.analysis.results.curves
    for agent in ("Q-learning & co", "sarsa"):
        rows = summary[
            (summary["agent"] == agent)
            & (summary["environment"] == "FrozenLake-v1")
            & (summary["kind"] == "evaluation")
        ]
        last = rows.groupby("seed")["value"].last().mean()
        assert curves[agent]["y"][-1] == pytest.approx(last, rel=1e-4)
        assert curves[agent]["x"][-1] == 2000


def test_the_curves_stand_in_a_table_too(page):
    tables = [text for _, text in page.all("details") if "as a table" in text]
    assert len(tables) == 2
    for place, table in enumerate(tables):
        assert re.findall(r"\d+ %", table) == ["10 %", "25 %", "50 %", "100 %"]
        for agent, curve in data_of(page, f"data-curves-{place}")["evaluation"]["by_axis"][
            "step"
        ].items():
            row = table[table.index(agent) + len(agent) :].replace(",", "")
            cells = re.findall(r"(\S+)\s+(?:\S+ to \S+ )?(\d+) steps", row)[:4]
            means, steps = np.array(cells, dtype=float).T
            assert steps.tolist() == [200, 500, 1000, 2000]
            assert means == pytest.approx(
                np.interp(steps, curve["x"], curve["y"]), rel=1e-3, abs=1e-4
            )


def test_an_agent_has_the_colour_of_the_printed_figures(page, report_study):
    marks = data_of(page, "data-page")["agents"]
    printed = agent_marks(report_study.study)
    assert [COLOURS[mark["colour"]] for mark in marks] == [
        line_style(printed[mark["label"]])["color"] for mark in marks
    ]


def test_the_matrices_show_pairs_from_both_sides(report_study):
    environment = report_study.analysis.environments[0]
    first, both = environment.pairs[0], pairs_both_ways(environment)
    assert len(both) == 2 * len(environment.pairs)
    assert both[first.first, first.second] == first
    seen = both[first.second, first.first].probability_of_improvement.point
    assert seen == 1 - first.probability_of_improvement.point


def test_the_maps_are_those_of_the_run_folders(page, report_study):
    data = data_of(page, "data-policies-0")
    assert data["rows"] == ["S...", ".X.X", "...X", "X..G"]
    run = next(r for r in data["runs"] if (r["agent"], r["seed"]) == ("sarsa", 0))
    folder = next(r for r in report_study.planned if r.agent == "sarsa" and r.seed == 0)
    with np.load(folder.run.value_maps_path) as maps:
        assert run["steps"] == maps["timesteps"].tolist()
        assert run["values"][-1] == pytest.approx(maps["values"][-1].tolist(), rel=1e-4)
        assert [int(digit) for digit in run["actions"][-1]] == maps["actions"][-1].tolist()
        best = [
            [bool(bits >> action & 1) for action in range(4)] for bits in data["optimum"]["actions"]
        ]
        assert best == maps["optimal_actions"].tolist()
    # Holes and the goal end the episode: nothing is done there.
    assert data["matters"] == "1111101011100110"


def test_a_film_is_small_and_made_once(report_study):
    run = report_study.planned[0]
    film = film_of(run)
    assert film is not None
    before = film.stat().st_mtime_ns
    assert film_of(run) == film
    assert film.stat().st_mtime_ns == before
    assert film.stat().st_size <= 2 * MAX_BYTES
    from PIL import Image

    with Image.open(film) as picture:
        assert max(picture.size) <= MAX_SIDE
        assert picture.n_frames > 1


def test_films_have_room_for_all_environments(report_study, monkeypatch):
    """Two agents of one route share a film; what has no room is named."""
    report = Report(study_series(report_study.analysis), "")
    everything = world_sections.played_episodes(report)
    assert sum(map(len, everything.context["films"])) == 6
    assert not any(everything.context["without_room"])
    assert len(everything.data) == len(set(everything.data)) <= 6
    sizes = [film_of(run).stat().st_size for run in report_study.planned if run.seed == 0]
    # Half of it is the first environment's.
    monkeypatch.setattr(world_sections, "ALL_BYTES", 2 * min(sizes))
    films = world_sections.played_episodes(report)
    shown, left = films.context["films"], films.context["without_room"]
    told = [len(a) + len(b) for a, b in zip(shown, left, strict=True)]
    assert told == [3, 3]
    assert any(films.context["without_room"])
    monkeypatch.setattr(world_sections, "ALL_BYTES", 0)
    assert world_sections.played_episodes(report) is None


def test_maps_share_the_room_of_the_page(report_study, monkeypatch):
    report = Report(study_series(report_study.analysis), "")
    # Two kinds of figures on 16 cells, of 2 agents, at 4 moments; another environment has as much.
    monkeypatch.setattr(world_sections, "MAX_FIGURES", 2 * (2 * 16 * 2 * 4))
    lake, warehouse = world_sections.policies(report).places
    assert [run["seed"] for run in lake["runs"]] == [0, 0]
    for run in lake["runs"]:
        assert len(run["steps"]) == len(run["values"]) == len(run["actions"]) == 4
        assert run["steps"][-1] == 2000
    assert [len(run["steps"]) for run in warehouse["runs"]] == [2, 2]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("episode.json", "{}"),
        ("episode.json", "["),
        ("episode.json", '{"frames": "x", "steps": 1, "return": 1.0}'),
        ("episode.json", '{"frames": 3, "steps": 1, "return": 1e999}'),
        ("episode.gif", "GIF89a"),
        ("episode.gif", "no picture"),
    ],
)
def test_a_film_that_is_none_is_made_anew(report_study, name, content):
    run = report_study.planned[0]
    before = film_of(run).read_bytes()
    (run.path / name).write_text(content)
    assert film_of(run).read_bytes() == before
    assert json.loads((run.path / "episode.json").read_text())["frames"] > 1


# --- nothing gets in, nothing gets out -----------------------------------------------------------


def test_labels_stay_text(page, text):
    assert HOSTILE in page.all("section")[2][1]
    scripts = [script for _, script in page.all("script")]
    assert not [script for script in scripts if script.startswith("document.title")]
    assert len(scripts) == len(data_names(page)) + 4
    assert "<b>bold" not in text.split("</head>")[1].split("<script")[0]


def test_the_policy_allows_the_scripts_of_the_page_and_nothing_from_outside(page):
    policies = [
        a["content"]
        for a, _ in page.all("meta")
        if a.get("http-equiv") == "Content-Security-Policy"
    ]
    assert len(policies) == 1
    directives = dict(part.strip().split(" ", 1) for part in policies[0].split(";"))
    assert directives["default-src"] == "'none'"
    assert directives["img-src"] == "data: blob:"
    # These two do not follow from default-src.
    assert directives["form-action"] == directives["base-uri"] == "'none'"
    running = [s for a, s in page.all("script") if a.get("type") is None]
    kept = {a["id"]: s for a, s in page.all("script") if a.get("type") == "text/plain"}
    running += [gzip.decompress(base64.b64decode(kept["plotly"])).decode(), kept["own"]]
    hashes = {
        f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'"
        for s in running
    }
    assert set(directives["script-src"].split()) == hashes
    assert len(hashes) == 4


def test_nothing_is_loaded(page):
    for tag, attributes in page.elements:
        for name, value in attributes.items():
            assert not name.startswith("on"), (tag, name)
            if name in LOADING or (tag == "link" and name == "href"):
                assert value.startswith("data:"), (tag, name, value[:80])
        assert tag not in {"iframe", "object", "embed", "base"}
    for _, style in page.all("style"):
        assert "@import" not in style
        assert "url(" not in style


def test_the_page_is_not_too_heavy(report_study):
    plotly = 2_000_000
    assert report_study.page.stat().st_size < plotly + 1_500_000


# --- pieces --------------------------------------------------------------------------------------


def test_plain_data_is_json_rounded_and_without_what_is_not_finite():
    value = {"a": np.array([1.23456789, np.nan]), 2: (np.int64(3), np.float64(np.inf), "x", True)}
    assert plain(value) == {"a": [1.2346, None], "2": [3, None, "x", True]}


@pytest.mark.parametrize("text", ["a</script>", "b</SCRIPT >", "<!-- c"])
def test_a_script_that_would_end_its_element_is_refused(text):
    with pytest.raises(ValueError, match="may not hold"):
        inline_script(text)


def test_words_for_figures():
    assert interval_alone(Estimate(1.0, 0.5, 1.5, 4)) == "0.5 to 1.5"
    assert interval_alone(Estimate(1.0, 1.0, 1.0, 4)) == ""
    assert interval_alone(Estimate(1.0, math.nan, math.nan, 1)) == ""
    assert [p_value(p) for p in (0.0004, 0.0314, 1.0, math.nan)] == [
        "< 0.001",
        "0.031",
        "1.000",
        "-",
    ]
    assert [setting(v) for v in (True, None, "lin_0.1", {"a": [1]})] == [
        "true",
        "null",
        "lin_0.1",
        '{"a": [1]}',
    ]


def test_plotly_is_packed_as_it_is():
    """The same page for the same study: no time of day is packed with it."""
    text = get_plotlyjs()
    letters = packed(text)
    assert gzip.decompress(base64.b64decode(letters)).decode() == text
    assert len(letters) < 0.45 * len(text)
    assert packed(text) == letters


def test_small_figures_keep_the_lines_within(page, report_study):
    found = result_sections.overview(Report(study_series(report_study.analysis), ""))
    lake, warehouse = found.context["figures"]
    assert (lake.name, warehouse.name) == ("FrozenLake-v1", "Warehouse-v0")
    for figure in (lake, warehouse):
        assert list(figure.lines) == [
            agent.agent
            for environment in report_study.analysis.environments
            if environment.environment == figure.name
            for agent in environment.agents
        ]
        corners = np.array(
            [corner.split(",") for line in figure.lines.values() for corner in line.split()],
            dtype=float,
        )
        assert (corners >= 0).all()
        assert corners[:, 0].max() == result_sections.WIDTH
        assert corners[:, 1].max() <= result_sections.HEIGHT
        # Nothing lies above the optimum.
        assert corners[:, 1].min() >= figure.optimum - 0.1


def test_labels_break_where_their_words_end():
    assert breakable("FrozenLake8x8-v1") == "Frozen<wbr>Lake8x8-<wbr>v1"
    assert breakable("ALE/Pong-v5") == "ALE/<wbr>Pong-<wbr>v5"
    assert breakable("<b>-x") == "&lt;b&gt;-<wbr>x"


# --- sweeps --------------------------------------------------------------------------------------


@pytest.fixture
def sweep_page(made_up, tmp_path):
    """The verdicts of a sweep as a page: one parameter on the lake, two on the island."""
    labels = ["a = 1", "a = 2", "a = 3", "other"]
    agents = [made_up.agent(label, 90.0 - 10 * n) for n, label in enumerate(labels)]
    places = [made_up.environment(agents, label) for label in ("lake", "island")]
    analysis = made_up.analysis(places, labels, tmp_path)
    analysis = replace(
        analysis,
        results=replace(analysis.results, study=replace(analysis.study, description="Why?")),
    )
    x, means = np.array([1.0, 2, 3]), np.array([[90.0, 80], [70, np.nan]])
    sweep = Sweep("a", Curve(x, np.array([90.0, 80, 70]), x, x), tuple(labels[:3]))
    grid = Grid(("a", "e"), ["1", "2"], ["3", "4"], means, [labels[:2], [labels[2], ""]])
    series = [
        EnvironmentSeries(places[0], None, (), None, {"swept": sweep}),
        EnvironmentSeries(places[1], None, (), None, {}, {"swept": grid}),
    ]
    report = Report(StudySeries(analysis, agent_marks(analysis.study), tuple(series)), "compare")
    return Page(render(report, [result_sections.verdict(report)]))


def test_a_sweep_has_its_answer_on_top(sweep_page):
    assert [text for _, text in sweep_page.all("summary")] == ["What is asked"]
    (plot,) = [a for a, _ in sweep_page.all("div") if "data-card" in a]
    sweeps = data_of(sweep_page, "data-verdict")["sweeps"]
    assert list(sweeps[int(plot["data-card"])]) == ["swept"]
    found = sweeps[0]["swept"]
    assert (found["parameter"], found["x"], found["y"]) == ("a", [1, 2, 3], [90, 80, 70])
    assert found["best"] == [True, False, False]
    assert sweeps[1] == {}


def test_a_heat_map_stands_on_the_page_with_its_best_value(sweep_page):
    cells = [(a, text) for a, text in sweep_page.all("td") if "best" in a.get("class", "")]
    assert [text for _, text in cells] == ["90 best"]
    shaded = {
        text: a["style"] for a, text in sweep_page.all("td") if "--strength" in a.get("style", "")
    }
    assert shaded == {"90 best": "--strength: 90%", "80": "--strength: 45%", "70": "--strength: 0%"}
    assert "by a (down) and e (across)" in " ".join(
        text for _, text in sweep_page.all("figcaption")
    )

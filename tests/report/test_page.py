"""The page of a study: what is on it, and that nothing can be put into it or drawn from outside."""

import base64
import gzip
import hashlib
import json
import platform
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from rl_yardstick.experiments.analysis import analyse
from rl_yardstick.experiments.results import read_compared
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.report.films import MAX_BYTES, MAX_SIDE, film_of
from rl_yardstick.report.page import render, world_sections
from rl_yardstick.report.page.frame import Report
from rl_yardstick.report.series import study_series
from tests.report.made_up import HOSTILE

SECTION_NAMES = [
    *("verdict", "ranking", "curves", "comparison", "overall"),
    *("why", "policies", "films", "settings"),
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
        pairs = zip(self.elements, self.texts, strict=True)
        return [(attributes, text) for (name, attributes), text in pairs if name == tag]

    def data(self, name):
        """What a script works with; None where there is no such thing."""
        found = [text for attributes, text in self.all("script") if attributes.get("id") == name]
        return json.loads(gzip.decompress(base64.b64decode(found[0]))) if found else None

    @property
    def sections(self):
        return {attributes["id"]: text for attributes, text in self.all("section")}


@pytest.fixture(scope="module")
def text(report_study):
    return report_study.page.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def test_settings_say_how_it_was_done_and_what_failed_and_not_where(page, report_study):
    assert [*page.sections] == SECTION_NAMES
    settings, info = page.sections["settings"], report_study.planned[0].recorded()
    for part in ("python compare.py 'a & b.yml'", info["versions"]["numpy"]):
        assert part in settings
    assert info["machine"]["processor"] in settings
    assert platform.node() not in "".join(info["machine"].values())
    assert "looked at" not in settings  # nobody has, by the file
    assert re.search(r"on Warehouse-v0, seed 1:\s+ValueError: <the> disk & all is full", settings)


def test_curves_end_with_the_final_evaluations_and_stand_in_a_table_too(page, report_study):
    summary = report_study.analysis.results.curves
    summary = summary[summary["kind"] == "evaluation"]
    tables = [text for _, text in page.all("details") if "as a table" in text]
    for place, name in enumerate(("FrozenLake-v1", "Warehouse-v0")):
        assert re.findall(r"\d+ %", tables[place]) == ["10 %", "25 %", "50 %", "100 %"]
        curves = page.data(f"data-curves-{place}")["evaluation"]["by_axis"]["step"]
        for agent, curve in curves.items():
            rows = summary[(summary["agent"] == agent) & (summary["environment"] == name)]
            last = rows.groupby("seed")["value"].last().mean()
            assert curve["y"][-1] == pytest.approx(last, rel=1e-4)
            row = tables[place].partition(agent)[2].replace(",", "")
            cells = re.findall(r"(\S+)\s+(?:\S+ to \S+ )?(\d+) steps", row)[:4]
            means, steps = np.array(cells, dtype=float).T
            assert steps.tolist() == [200, 500, 1000, 2000]
            shown = np.interp(steps, curve["x"], curve["y"])
            assert means == pytest.approx(shown, rel=1e-3, abs=1e-4)


def test_the_maps_are_those_of_the_run_folders(page, report_study):
    data = page.data("data-policies-0")
    assert data["rows"] == ["S...", ".X.X", "...X", "X..G"]
    run = next(r for r in data["runs"] if (r["agent"], r["seed"]) == ("sarsa", 0))
    folder = next(r for r in report_study.planned if r.agent == "sarsa" and r.seed == 0)
    with np.load(folder.path / "value_maps.npz") as maps:
        assert run["steps"] == maps["timesteps"].tolist()
        assert run["values"][-1] == pytest.approx(maps["values"][-1].tolist(), rel=1e-4)
        assert [int(digit) for digit in run["actions"][-1]] == maps["actions"][-1].tolist()
        optimum = data["optimum"]["actions"]
        best = [[bool(bits >> action & 1) for action in range(4)] for bits in optimum]
        assert best == maps["optimal_actions"].tolist()
    # Holes and the goal end the episode: nothing is done there.
    assert data["matters"] == "1111101011100110"


def test_a_film_is_small_and_made_once(report_study):
    film = film_of(report_study.planned[0])
    before = film.stat().st_mtime_ns
    assert film_of(report_study.planned[0]).stat().st_mtime_ns == before
    assert film.stat().st_size <= 2 * MAX_BYTES
    with Image.open(film) as picture:
        assert max(picture.size) <= MAX_SIDE
        assert picture.n_frames > 1


def test_labels_stay_text(page, text):
    assert HOSTILE in page.sections["ranking"]
    scripts = page.all("script")
    assert not [script for _, script in scripts if script.startswith("document.title")]
    assert len(scripts) == sum("data-packed" in a for a, _ in scripts) + 4
    assert "<b>bold" not in text.split("</head>")[1].split("<script")[0]


def test_the_policy_allows_the_scripts_of_the_page_and_nothing_from_outside(page):
    (policy,) = [a["content"] for a, _ in page.all("meta") if "http-equiv" in a]
    directives = dict(part.strip().split(" ", 1) for part in policy.split(";"))
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


def test_what_runs_were_compared_with_has_a_curve_for_each_agent(tmp_path, do_study):
    agents = tuple(AgentSpec(name, name) for name in ("qlearning", "sarsa"))
    places = (EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 400}),)
    study = StudySpec("small", "", agents, places, 2, eval_freq=100, eval_episodes=1, diagnose=True)
    results = do_study(study, tmp_path / "runs")
    report = Report(study_series(analyse(results)), "compare.py")
    page = Page(render(report, [world_sections.diagnosis(report)]))
    lake = page.data("data-diagnosis-0")
    assert lake["v_error"].keys() == {"qlearning", "sarsa"}
    assert lake["overestimation"].keys() == {"qlearning"}
    runs = [one.path for one in results.planned if one.labels == ("sarsa", "lake")]
    curve = lake["v_error"]["sarsa"]
    assert curve["x"][-1] == 400
    last = np.mean([read_compared(run)["v_error"][-1] for run in runs])
    assert curve["y"][-1] == pytest.approx(last, rel=1e-4)
    assert page.data("data-diagnosis").keys() >= lake.keys()

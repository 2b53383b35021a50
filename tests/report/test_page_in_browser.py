"""The page in a browser: it draws, moves, sorts, and asks nobody for anything."""

import contextlib
import json
import time
from itertools import pairwise
from types import SimpleNamespace

import pytest
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from experiments.analysis import analyse
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from report.documents import MARKUPS, verdicts_as
from report.page import write_report
from report.page.frame import STYLES, Report, template_file, templates
from report.page.tuning import write_tuning_page
from report.series import agent_marks, study_series
from tests.report.browsing import (
    find,
    find_all,
    has_scripts,
    needs_browser,
    plots,
    resize,
    script_click,
    wait,
)
from verdicts import Estimate

pytestmark = needs_browser


@pytest.fixture
def loaded(browser, report_study):
    """The page, freshly loaded in a wide window; figures are drawn as they come near."""
    resize(browser, 1280)
    browser.get(report_study.page.as_uri())
    with contextlib.suppress(Exception):
        browser.execute_script("localStorage.clear()")
    wait(browser, lambda: has_scripts(browser))
    return browser


@pytest.fixture
def page(loaded):
    """The same with all figures drawn."""
    wait(loaded, lambda: plots(loaded) >= 5)
    return loaded


@pytest.fixture(scope="module")
def bandit_study(do_study, tmp_path_factory):
    """The page of a study on two bandits, one of them with contexts."""
    places = tuple(
        EnvironmentSpec(name, name, {"n_timesteps": 300})
        for name in ("BernoulliBandit-v0", "SegmentBandit-v0")
    )
    agents = tuple(AgentSpec(name, name, tuned=False) for name in ("thompson", "epsilon_greedy"))
    root = tmp_path_factory.mktemp("bandits")
    study = StudySpec("b", "Bandits", agents, places, n_seeds=3, metric="regret")
    path = root / "report.html"
    write_report(Report(study_series(analyse(do_study(study, root))), "compare.py b.yml"), path)
    return path


@pytest.fixture
def bandit_page(browser, bandit_study):
    """The page on bandits, freshly loaded in a wide window, with nothing in the log."""
    resize(browser, 1280)
    browser.get_log("browser")
    browser.get(bandit_study.as_uri())
    wait(browser, lambda: plots(browser) >= 6)
    return browser


def figure(browser, css):
    """What Plotly holds for a figure."""
    return browser.execute_script(
        """
        const plot = document.querySelector(arguments[0]);
        report.drawAll();
        return {
          x: plot.data.map((trace) => trace.x),
          y: plot.data.map((trace) => trace.y),
          names: plot.data.map((trace) => trace.name).filter((name) => name),
          xTitle: plot.layout.xaxis.title?.text,
          xType: plot.layout.xaxis.type,
          yTitle: plot.layout.yaxis.title?.text,
          tickText: plot.layout.yaxis.ticktext,
          ink: plot.layout.font.color,
          shapes: plot.layout.shapes?.length,
        };
        """,
        css,
    )


def choose(browser, name, value):
    script_click(browser, find(browser, f'input[name="{name}"][value="{value}"]'))


def first_column(browser):
    return [
        row.find_element(By.CSS_SELECTOR, "th").text
        for row in find_all(browser, "#ranking figure:not([hidden]) tbody tr")
    ]


def test_it_loads_without_an_error_and_without_the_network(page, report_study):
    page.get_log("performance")
    page.get_log("browser")
    page.get(report_study.page.as_uri())
    wait(page, lambda: plots(page) >= 5)
    Select(find(page, "#environment")).select_by_index(1)
    time.sleep(0.5)
    assert page.get_log("browser") == []
    messages = [json.loads(entry["message"])["message"] for entry in page.get_log("performance")]
    asked = [
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    ]
    own = report_study.page.as_uri()
    assert own in asked
    assert [
        url[:80] for url in asked if url != own and not url.startswith(("data:", "blob:"))
    ] == []


def test_a_hostile_label_is_only_text(page):
    assert page.title == "Small & <b>bold</b>"
    assert find_all(page, "main b") == []
    assert "</script><script>document.title='taken'</script>" in find(page, "#ranking").text
    labels = page.execute_script(
        "return [...document.querySelectorAll('#intervals .ytick')].map(t => t.textContent).join()"
    )
    assert "document.title" in labels
    assert "<script>" in labels


def test_the_toggles_change_the_curves(page):
    before = figure(page, "#curves .plot")
    assert before["xTitle"] == "environment steps"
    assert before["yTitle"] == "return of evaluations"
    assert before["shapes"] == 2  # the optimum and the best random or constant policy
    choose(page, "by", "episode")
    by_episode = figure(page, "#curves .plot")
    assert by_episode["xTitle"] == "episodes"
    assert by_episode["x"] != before["x"]
    choose(page, "by", "seconds")
    assert figure(page, "#curves .plot")["xTitle"] == "wall time (s)"
    choose(page, "kind", "training")
    choose(page, "by", "step")
    training = figure(page, "#curves .plot")
    assert training["yTitle"] == "return of training episodes"
    assert training["y"] != before["y"]
    choose(page, "across", "log")
    assert figure(page, "#curves .plot")["xType"] == "log"


def test_toggles_are_reached_and_used_by_keyboard(page):
    find(page, 'input[name="by"][value="step"]').send_keys(Keys.ARROW_RIGHT)
    assert figure(page, "#curves .plot")["xTitle"] == "episodes"
    find(page, "#curves .legend button").send_keys(Keys.SPACE)
    assert len(figure(page, "#curves .plot")["names"]) == 2


def test_an_axis_for_returns_that_dwarf_the_others(page):
    assert not find(page, '[data-switch="scale"]').is_displayed()
    Select(find(page, "#environment")).select_by_index(1)  # where random actions cost 27,000
    assert find(page, '[data-switch="scale"]').is_displayed()
    compressed = figure(page, "#curves .plot")
    assert "-10,000" in compressed["tickText"]
    choose(page, "scale", "linear")
    plain = figure(page, "#curves .plot")
    assert plain["tickText"] is None
    assert min(v for y in plain["y"] for v in y) < -10_000
    assert min(v for y in compressed["y"] for v in y) > -10


def test_training_on_a_variant_is_marked_at_the_curve_and_in_the_legend(page):
    # Data of an environment are parsed when it is first chosen.
    page.execute_script(
        """
        const element = document.getElementById("data-curves-1");
        const data = JSON.parse(element.textContent);
        data.training.on_variant = ["sarsa"];
        element.textContent = JSON.stringify(data);
        """
    )
    Select(find(page, "#environment")).select_by_index(1)

    def legend():
        return [button.text for button in find_all(page, "#curves .legend button")]

    assert sum("on a variant" in text for text in legend()) == 0
    choose(page, "kind", "training")
    assert [text for text in legend() if "on a variant" in text] == ["sarsa\non a variant"]
    training = figure(page, "#curves .plot")
    assert "sarsa (on a variant)" in training["names"]
    assert not training["shapes"]
    circled = page.execute_script(
        "return document.querySelector('#curves .plot').data"
        ".filter((t) => t.marker?.symbol === 'circle-open').map((t) => t.name)"
    )
    assert circled == ["sarsa (on a variant)"]
    assert "Circles: trained on a variant" in find(page, "#curves figcaption").text
    choose(page, "kind", "evaluation")
    assert sum("on a variant" in text for text in legend()) == 0


def test_hiding_an_agent_in_the_legend(page):
    names = figure(page, "#curves .plot")["names"]
    button = find_all(page, "#curves .legend button")[0]
    script_click(page, button)
    assert button.get_attribute("aria-pressed") == "false"
    assert figure(page, "#curves .plot")["names"] == names[1:]
    script_click(page, button)
    assert figure(page, "#curves .plot")["names"] == names


@pytest.mark.parametrize("way", ["click", "keyboard"])
def test_a_heading_sorts_the_ranking(loaded, way):
    ranked = first_column(loaded)
    heading = find(loaded, "#ranking figure:not([hidden]) thead th:nth-child(2)")
    button = heading.find_element(By.CSS_SELECTOR, "button")

    def press():
        if way == "click":
            script_click(loaded, button)
        else:
            button.send_keys(Keys.ENTER)

    assert heading.get_attribute("aria-sort") == "descending"
    press()
    assert heading.get_attribute("aria-sort") == "ascending"
    assert first_column(loaded) == ranked[::-1]
    press()
    assert heading.get_attribute("aria-sort") == "descending"
    assert first_column(loaded) == ranked


def test_names_sort_as_text(loaded):
    heading = find(loaded, "#ranking figure:not([hidden]) thead th")
    script_click(loaded, heading.find_element(By.CSS_SELECTOR, "button"))
    assert [name[0] for name in first_column(loaded)] == ["<", "Q", "s"]
    assert len(find_all(loaded, "#ranking figure:not([hidden]) th[aria-sort]")) == 1


def test_the_environment_changes_everywhere(page):
    Select(find(page, "#environment")).select_by_visible_text("Warehouse-v0")
    shown = [e.text for e in find_all(page, "h2 .where") if e.is_displayed()]
    assert set(shown) == {"Warehouse-v0"}
    assert len(find_all(page, ".board:first-child [data-cell]")) == 100
    names = figure(page, "#intervals")["names"]
    assert len(names) == 3


def test_the_slider_moves_the_map_by_keyboard_and_says_where_it_is(loaded):
    slider = find(loaded, "#progress")
    board = find_all(loaded, ".board")[1]
    assert slider.get_attribute("aria-valuetext") == "after 2,000 steps"
    last = board.get_attribute("innerHTML")
    slider.send_keys(Keys.HOME)
    label = find(loaded, "#policies output").text
    assert label.startswith("after ")
    assert label != "after 2,000 steps"
    assert slider.get_attribute("aria-valuetext") == label
    first = find_all(loaded, ".board")[1].get_attribute("innerHTML")
    assert first != last
    slider.send_keys(Keys.ARROW_RIGHT)
    assert find(loaded, "#policies output").text != label
    slider.send_keys(Keys.END)
    assert find_all(loaded, ".board")[1].get_attribute("innerHTML") == last


def test_the_map_marks_what_is_not_optimal_and_tells_a_cell(loaded):
    boards = find_all(loaded, ".board")
    assert boards[0].find_elements(By.CSS_SELECTOR, ".differs") == []
    assert boards[0].text.startswith("optimum")
    for board in boards[1:]:
        marked = len(board.find_elements(By.CSS_SELECTOR, ".differs"))
        assert f"{11 - marked} of 11 cells" in board.text
    loaded.execute_script(
        "document.querySelector('.board [data-cell=\"14\"]')"
        ".dispatchEvent(new PointerEvent('pointerover', {bubbles: true}))"
    )
    told = find(loaded, "#policies .cell").text
    assert told.startswith("row 4, column 3: optimum 0.924 (down)")


def test_another_seed_has_another_map(loaded):
    before = find_all(loaded, ".board")[1].get_attribute("innerHTML")
    Select(find(loaded, "#policies .seed select")).select_by_index(1)
    assert find_all(loaded, ".board")[1].get_attribute("innerHTML") != before


def test_films_play_and_stop(loaded):
    screen = find(loaded, ".films:not([hidden]) .screen")
    picture = screen.find_element(By.CSS_SELECTOR, "img")
    assert picture.get_attribute("src").startswith("data:image/gif")
    script_click(loaded, screen)
    assert screen.get_attribute("aria-pressed") == "false"
    assert picture.get_attribute("src").startswith("data:image/png")
    screen.send_keys(Keys.ENTER)
    assert picture.get_attribute("src").startswith("data:image/gif")


def test_films_stand_still_for_those_who_ask_for_less_motion(page, report_study):
    features = [{"name": "prefers-reduced-motion", "value": "reduce"}]
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    try:
        page.get(report_study.page.as_uri())
        wait(page, lambda: plots(page) >= 5)
        sources = [e.get_attribute("src")[:14] for e in find_all(page, ".screen img")]
        assert set(sources) == {"data:image/png"}
    finally:
        page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_the_theme_follows_the_system_and_the_button(page):
    def theme():
        return page.execute_script("return document.documentElement.dataset.theme")

    def background():
        return page.execute_script("return getComputedStyle(document.body).backgroundColor")

    assert theme() == "light"
    light, ink = background(), figure(page, "#curves .plot")["ink"]
    features = [{"name": "prefers-color-scheme", "value": "dark"}]
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    try:
        wait(page, lambda: theme() == "dark")
        assert background() != light
        assert figure(page, "#curves .plot")["ink"] != ink
        button = find(page, "#theme")
        script_click(page, button)
        assert (button.text, theme(), background()) == ("Theme: light", "light", light)
        button.send_keys(Keys.ENTER)
        assert (button.text, theme()) == ("Theme: dark", "dark")
    finally:
        page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


@pytest.mark.parametrize("width", [380, 320])
def test_a_phone_has_nothing_beyond_its_edge(page, width):
    resize(page, width)
    for environment in (0, 1):
        Select(find(page, "#environment")).select_by_index(environment)
        time.sleep(0.3)
        reach = page.execute_script("return document.documentElement.scrollWidth")
        assert reach <= width


def test_curves_by_pull_change_with_their_toggles(bandit_page):
    regret = figure(bandit_page, "#pull-regret")
    assert (regret["xTitle"], regret["xType"]) == ("pulls (log scale)", "log")
    assert "Auer, for UCB1" in regret["names"]
    choose(bandit_page, "pull-axis", "linear")
    assert figure(bandit_page, "#pull-regret")["xType"] == "linear"
    choose(bandit_page, "pull-spread", "runs")
    assert figure(bandit_page, "#pull-regret")["y"] != regret["y"]
    script_click(bandit_page, find_all(bandit_page, "#bandits .legend button")[0])
    assert len(figure(bandit_page, "#pull-optimal")["names"]) == 1
    assert len(figure(bandit_page, "#arm-shares")["names"]) == 1
    assert bandit_page.get_log("browser") == []


def test_beliefs_are_chosen_by_context_and_moment(bandit_page):
    # One context has nothing to choose from.
    assert not find(bandit_page, ".pick.context").is_displayed()
    Select(find(bandit_page, "#environment")).select_by_index(1)
    last = figure(bandit_page, "#pull-posteriors")
    assert last["names"] == ["arm 0", "arm 1", "arm 2"]
    Select(find(bandit_page, ".pick.context select")).select_by_index(1)
    casual = figure(bandit_page, "#pull-posteriors")
    assert casual["y"] != last["y"]
    Select(find(bandit_page, ".pick.moment select")).select_by_index(0)
    first = figure(bandit_page, "#pull-posteriors")
    # A density that knows less is lower.
    assert max(v for y in first["y"] for v in y) < max(v for y in casual["y"] for v in y)
    assert bandit_page.get_log("browser") == []


def test_the_table_of_arms_is_that_of_the_environment(bandit_page):
    def rows():
        cells = find_all(bandit_page, "#bandits figure tbody tr th")
        return [cell.text for cell in cells if cell.is_displayed()]

    assert len(rows()) == 4
    Select(find(bandit_page, "#environment")).select_by_index(1)
    assert len(rows()) == 8
    assert rows()[-1] == "context 1, regret of a pull"


def test_a_phone_shows_bandits_within_its_edge(bandit_page):
    resize(bandit_page, 380)
    for environment in (0, 1):
        Select(find(bandit_page, "#environment")).select_by_index(environment)
        time.sleep(0.3)
        assert bandit_page.execute_script("return document.documentElement.scrollWidth") <= 380


# --- on paper ------------------------------------------------------------------------------------

PAPER = 688  # CSS pixels between the margins of A4


@pytest.fixture
def paper(browser, report_study):
    """The page as it is printed from a dark screen."""
    dark = {"name": "prefers-color-scheme", "value": "dark"}
    resize(browser, PAPER)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [dark]})
    browser.get(report_study.page.as_uri())
    wait(browser, lambda: plots(browser) >= 5)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print", "features": [dark]})
    wait(browser, lambda: find_all(browser, ".sheet"))
    yield browser
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": []})


def test_paper_has_every_environment_and_loses_nothing_at_its_edge(paper):
    shown = [e.text for e in find_all(paper, "h2 .where") if e.is_displayed()]
    # Ranking, learning curves, differences, policies, films, settings.
    assert shown == ["FrozenLake-v1", "Warehouse-v0"] * 6
    for css in (".sheet .plot .main-svg", ".sheet table", ".sheet .board", "h1", "#verdict .card"):
        rights = paper.execute_script(
            "return [...document.querySelectorAll(arguments[0])]"
            ".filter((e) => e.getClientRects().length)"
            ".map((e) => e.getBoundingClientRect().right)",
            css,
        )
        assert rights, css
        assert max(rights) <= PAPER, css
    assert find_all(paper, "details:not([open])") == []


def test_curves_on_paper_go_to_the_last_step_in_light_colours(paper):
    drawn = paper.execute_script(
        """
        const plot = document.querySelector(".sheet .tall .main-svg");
        const ticks = [...document.querySelectorAll(".sheet .tall .xtick text")];
        return {
          last: ticks.map((tick) => tick.textContent).includes("2,000") ||
            ticks.map((tick) => tick.textContent).includes("2k"),
          ink: getComputedStyle(ticks[0]).fill,
          page: getComputedStyle(document.documentElement).getPropertyValue("--card"),
          clip: [...document.querySelectorAll(".sheet [clip-path]")].map((e) =>
            /#([^)"']+)/.exec(e.getAttribute("clip-path"))[1]),
        };
        """
    )
    assert drawn["last"]
    assert drawn["ink"] == "rgb(27, 31, 35)"
    assert drawn["page"].strip() == "#ffffff"
    # A drawing's parts are its own, not those of the same figure of another environment.
    assert drawn["clip"]
    for name in set(drawn["clip"]):
        assert len(find_all(paper, f'[id="{name}"]')) == 1, name


def test_after_printing_the_page_is_as_before(paper):
    paper.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "screen", "features": []})
    wait(paper, lambda: not find_all(paper, ".sheet"))
    shown = {e.text for e in find_all(paper, "h2 .where") if e.is_displayed()}
    assert shown == {"FrozenLake-v1"}
    assert find(paper, "#curves .controls").is_displayed()
    assert find_all(paper, "details[open]") == []


def test_figures_are_drawn_when_they_come_near(browser, report_study):
    resize(browser, 1280)
    browser.get(report_study.page.as_uri())
    assert find_all(browser, "#profiles .main-svg") == []
    browser.execute_script("document.querySelector('#profiles').scrollIntoView()")
    wait(browser, lambda: find_all(browser, "#profiles .main-svg"))


# --- for every eye and hand ----------------------------------------------------------------------


def test_a_small_figure_chooses_its_environment(loaded):
    small = find_all(loaded, "#overview [data-choose]")
    assert [one.get_attribute("aria-pressed") for one in small] == ["true", "false"]
    script_click(loaded, small[1])
    assert [one.get_attribute("aria-pressed") for one in small] == ["false", "true"]
    assert Select(find(loaded, "#environment")).first_selected_option.text == "Warehouse-v0"
    assert find(loaded, "#ranking .where:not([hidden])").text == "Warehouse-v0"


def test_the_arrows_go_from_cell_to_cell(loaded):
    board = find_all(loaded, ".board svg")[1]
    board.send_keys(Keys.ARROW_RIGHT)
    assert find(loaded, "#policies .cell").text.startswith("row 1, column 1: optimum 0.7442 (left)")
    board.send_keys(Keys.ARROW_DOWN, Keys.ARROW_DOWN, Keys.ARROW_DOWN, Keys.ARROW_DOWN)
    board.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    assert find(loaded, "#policies .cell").text.startswith("row 4, column 3: optimum 0.924 (down)")
    assert len(find_all(loaded, '.board [data-cell="14"] .cursor')) == len(
        find_all(loaded, ".board")
    )
    assert find(loaded, "#policies .cell").get_attribute("aria-live") == "polite"


def test_a_picture_to_take_along_has_title_legend_and_name(page):
    name, kind, picture = page.execute_script(
        """
        report.drawAll();
        return report.picture(document.querySelector("#curves .plot"), "svg")
          .then(async ({name, blob}) => [name, blob.type, await blob.text()]);
        """
    )
    assert name == "small-b-bold-b-learning-curves-frozenlake-v1.svg"
    assert kind == "image/svg+xml"
    assert "Learning curves · FrozenLake-v1" in picture
    assert "sarsa" in picture
    assert "<script" not in picture


def test_verdicts_to_take_along_are_those_beside_the_page(loaded, report_study):
    saved = loaded.execute_async_script(
        """
        const done = arguments[0];
        const files = [];
        report.download = async (name, blob) => {
          files.push([name, await blob.text()]);
          if (files.length === 2) done(files);
        };
        document.querySelectorAll("#verdict [data-suffix]").forEach((button) => button.click());
        """
    )
    assert [name for name, _ in saved] == [
        "small-b-bold-b-verdict.md",
        "small-b-bold-b-verdict.tex",
    ]
    for (_, text), markup in zip(saved, MARKUPS, strict=True):
        assert text == verdicts_as(markup, report_study.analysis, "python compare.py 'a & b.yml'")


def test_a_table_to_take_along(loaded):
    lines = loaded.execute_script(
        "return report.csv(document.querySelector('#ranking table'))"
    ).splitlines()
    assert lines[0].startswith('Agent,"Mean, over seeds",')
    assert len(lines) == 4
    assert sorted(line[:5] for line in lines[1:]) == ["</scr", "Q-lea", "sarsa"]
    mean = float(lines[1].split(",")[1])
    assert 0 <= mean <= 1
    matrix = loaded.execute_script(
        "return report.csv(document.querySelector('#comparison .square'))"
    ).splitlines()
    assert matrix[0].startswith("Agent,")
    assert matrix[0].count(",") == 3
    assert len(matrix) == 4
    # A label that a spreadsheet would run.
    guarded = loaded.execute_script(
        """
        const table = document.createElement("table");
        table.innerHTML = "<thead><tr><th>a</th><th>b</th></tr></thead>" +
          "<tbody><tr><th>=1+1</th><td data-value='-2'>-2</td></tr></tbody>";
        return report.csv(table);
        """
    )
    assert guarded == "a,b\n'=1+1,-2\n"


@pytest.mark.parametrize("width", [1280, 1024, 720])
def test_tables_need_no_sideways_scrolling_on_a_laptop_or_enlarged_to_twice(page, width):
    resize(page, width)
    assert page.execute_script("return document.documentElement.scrollWidth") <= width
    for css in ("#ranking", "#comparison"):
        reach, width = page.execute_script(
            "const e = document.querySelector(arguments[0] + ' figure:not([hidden]) .scroll');"
            "return [e.scrollWidth, e.clientWidth]",
            css,
        )
        assert reach <= width


@pytest.fixture(scope="module")
def wide_tables(tmp_path_factory):
    """The tables over all environments of ten agents on ten environments, without their figures."""
    names = [f"double_qlearning alpha=0.{i}" for i in range(10)]
    places = [f"FrozenLake8x{i}-v1" for i in range(10)]
    study = StudySpec("w", "Wide", tuple(AgentSpec(n, "dqn", tuned=False) for n in names), ())
    body = (
        templates()
        .get_template("overall.html")
        .render(
            agents=names,
            marks=agent_marks(study),
            environments=[SimpleNamespace(environment=place) for place in places],
            scores=[{name: Estimate(-0.1234, -10.25, 0.9876, 9) for name in names} for _ in places],
            probabilities={(one, two): Estimate(0.75, 0.5, 1, 9) for one in names for two in names},
        )
    )
    settings = (
        templates()
        .get_template("settings.html")
        .render(
            study=study,
            marks=agent_marks(study),
            environments=[SimpleNamespace(environment=places[0])],
            tables=[{"agents": names, "rows": {"learning_rate": (["exp_0.5_0.003"] * 10, False)}}],
            **dict.fromkeys(("command", "seeds", "absent", "mixed"), ""),
            **dict.fromkeys(("missing", "looks", "machine"), ()),
            versions={},
        )
    )
    style = "".join(template_file(name) for name in STYLES)
    path = tmp_path_factory.mktemp("wide") / "wide.html"
    text = f"<!DOCTYPE html><meta charset=utf-8><style>{style}</style><main>"
    text += f"<section id=wide>{body}</section><section id=settings>{settings}</section>"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("width", [1280, 1024])
def test_ten_agents_on_ten_environments_need_no_sideways_scrolling(browser, wide_tables, width):
    resize(browser, width)
    browser.get(wide_tables.as_uri())
    reaches = browser.execute_script(
        "return [...document.querySelectorAll('#wide .scroll')]"
        ".map((e) => [e.scrollWidth, e.clientWidth])"
    )
    assert len(reaches) == 2
    assert all(reach <= room for reach, room in reaches), reaches
    # Names break where their words end, and nowhere else.
    heights = browser.execute_script(
        "return [...document.querySelectorAll('#wide thead button')].map((e) => e.offsetHeight)"
    )
    assert max(heights) <= 80  # three lines


def test_ten_agents_fit_on_paper(browser, wide_tables):
    resize(browser, PAPER)
    browser.get(wide_tables.as_uri())
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print", "features": []})
    try:
        rights = browser.execute_script(
            "return [...document.querySelectorAll('table')]"
            ".map((e) => e.getBoundingClientRect().right)"
        )
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": []})
    assert len(rights) == 3
    assert max(rights) <= PAPER  # else a browser makes all that is printed smaller


def test_no_tick_is_printed_over_another(loaded):
    for low, high, linear in ((-27_427, 79, 79), (-1000, 79, 79), (-3, 1e6, 9)):
        at = loaded.execute_script(
            "const axis = report.symlog(arguments[2]);"
            "const {tickvals} = axis.ticks(arguments[0], arguments[1]);"
            "return [tickvals.sort((a, b) => a - b), axis.height(arguments[0]),"
            "        axis.height(arguments[1])]",
            low,
            high,
            linear,
        )
        ticks, bottom, top = at
        assert len(ticks) >= 4
        gaps = [b - a for a, b in pairwise(ticks)]
        assert min(gaps) >= 0.085 * (top - bottom)


def test_the_page_of_a_search_draws_and_fits_a_telephone(browser, tuning_record, tmp_path):
    path = tmp_path / "report.html"
    write_tuning_page(tuning_record, path, "retest/report.html")
    resize(browser, 390)
    browser.get_log("browser")
    browser.get(path.as_uri())
    wait(browser, lambda: plots(browser) >= 3)
    assert browser.execute_script("return document.querySelectorAll('.js-plotly-plot').length") == 3
    root = "return document.documentElement"
    widths = [browser.execute_script(f"{root}.{name}Width") for name in ("scroll", "client")]
    assert widths[0] == widths[1]
    assert "Triangles at the edge lie beyond it. Failed: trial 4." in find(browser, "#history").text
    assert browser.get_log("browser") == []

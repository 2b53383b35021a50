"""All pages in Chromium: they draw, move, sort, can be heard, and ask nobody for anything."""

import contextlib
import json
import os
import shutil
import time

import gymnasium as gym
import pytest
from gymnasium.envs.toy_text import TaxiEnv
from rich.console import Console
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

from experiments.analysis import analyse
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import carry_out, prepare
from report.documents import MARKUPS, verdicts_as
from report.page import write_report
from report.page.frame import Report
from report.page.learning import write_learning_page
from report.page.tuning import write_tuning_page
from report.series import study_series

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
# A missing browser would leave the pages untested unseen, so that in CI it is a failure.
pytestmark = pytest.mark.skipif(
    "CI" not in os.environ and not (BROWSER and DRIVER),
    reason="needs Chromium and its chromedriver",
)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
HOSTILE = "</script><script>document.title='taken'</script>"
PAPER = 688  # CSS pixels between the margins of A4


class Browser:
    """What tests do with a page."""

    def __init__(self, profile):
        assert BROWSER is not None, "the report has to be tested in Chromium: install it"
        assert DRIVER is not None, "the report has to be tested in Chromium: install chromedriver"
        options = webdriver.ChromeOptions()
        options.binary_location = BROWSER
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        self.driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
        self.run = self.driver.execute_script

    def load(self, path, width=1280, media="", **features):
        """With nothing in its logs and nothing remembered."""
        named = {"prefers-color-scheme": "light", "prefers-reduced-motion": "no-preference"}
        named |= {name.replace("_", "-"): value for name, value in features.items()}
        self.emulate(media, named)
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        for log in ("browser", "performance"):
            self.driver.get_log(log)
        self.driver.get(path.as_uri())
        with contextlib.suppress(Exception):
            self.run("localStorage.clear()")

    def emulate(self, media, features):
        listed = [{"name": name, "value": value} for name, value in features.items()]
        given = {"media": media, "features": listed}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", given)

    def wait(self, condition):
        WebDriverWait(self.driver, 30, 0.1).until(lambda _: condition())

    def plots(self, n):
        """Draws all figures, those too that nobody has come near yet, at least so many."""
        self.wait(lambda: self.run("return typeof report !== 'undefined'"))
        count = "report.drawAll(); return document.querySelectorAll('.plot .main-svg').length"
        self.wait(lambda: self.run(count) >= n)

    def find(self, css):
        return self.driver.find_element(By.CSS_SELECTOR, css)

    def all(self, css):
        return self.driver.find_elements(By.CSS_SELECTOR, css)

    def shown(self, css):
        return [element.text for element in self.all(css) if element.is_displayed()]

    def click(self, element):
        """Without a care what the sticky bar lies over."""
        self.run("arguments[0].click()", element)

    def choose(self, name, value):
        self.click(self.find(f'input[name="{name}"][value="{value}"]'))

    def select(self, css, place):
        Select(self.find(css)).select_by_index(place)

    def press(self, *keys):
        self.find("body").send_keys(*keys)

    def figure(self, css):
        """What Plotly holds for a figure."""
        return self.run(
            """
            const plot = document.querySelector(arguments[0]);
            report.drawAll();
            return {
              x: plot.data.map((trace) => trace.x),
              y: plot.data.map((trace) => trace.y),
              names: plot.data.map((trace) => trace.name).filter((name) => name),
              axes: [plot.layout.xaxis.title?.text, plot.layout.xaxis.type,
                     plot.layout.yaxis.title?.text],
              ink: plot.layout.font.color,
              shapes: plot.layout.shapes?.length,
            };
            """,
            css,
        )

    def asks_nobody(self, path):
        """The page is all that was loaded, and nothing was complained about."""
        assert self.driver.get_log("browser") == []
        entries = self.driver.get_log("performance")
        messages = [json.loads(entry["message"])["message"] for entry in entries]
        asked = [
            message["params"]["request"]["url"]
            for message in messages
            if message["method"] == "Network.requestWillBeSent"
        ]
        own = [url for url in asked if not url.startswith(("data:", "blob:"))]
        assert own == [path.as_uri()]

    def fits(self, width):
        assert self.run("return document.documentElement.scrollWidth") <= width


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    found = Browser(tmp_path_factory.mktemp("profile"))
    yield found
    found.driver.quit()


# --- a study --------------------------------------------------------------------------------------


@pytest.fixture
def page(browser, report_study):
    """Freshly loaded in a wide window, all figures drawn."""
    browser.load(report_study.page)
    browser.plots(5)
    return browser


def test_it_loads_without_an_error_and_without_the_network(page, report_study):
    page.select("#environment", 1)
    time.sleep(0.5)
    page.asks_nobody(report_study.page)
    # A hostile label is only text.
    assert page.driver.title == "Small & <b>bold</b>"
    assert page.all("main b") == []
    assert HOSTILE in page.find("#ranking").text
    labels = page.run(
        "return [...document.querySelectorAll('#intervals .ytick')].map(t => t.textContent).join()"
    )
    assert "document.title" in labels
    assert "<script>" in labels


def test_the_toggles_change_the_curves(page):
    before = page.figure("#curves .plot")
    assert before["axes"] == ["environment steps", "linear", "return of evaluations"]
    assert before["shapes"] == 2  # the optimum and the best random or constant policy
    page.choose("by", "episode")
    by_episode = page.figure("#curves .plot")
    assert by_episode["axes"][0] == "episodes"
    assert by_episode["x"] != before["x"]
    page.choose("by", "seconds")
    assert page.figure("#curves .plot")["axes"][0] == "wall time (s)"
    page.choose("kind", "training")
    page.choose("by", "step")
    page.choose("across", "log")
    training = page.figure("#curves .plot")
    assert training["axes"] == [
        "environment steps (log scale)",
        "log",
        "return of training episodes",
    ]
    assert training["y"] != before["y"]
    # By keyboard too; and agents are hidden in the legend.
    page.find('input[name="by"][value="step"]').send_keys(Keys.ARROW_RIGHT)
    assert page.figure("#curves .plot")["axes"][0] == "episodes (log scale)"
    button = page.find("#curves .legend button")
    button.send_keys(Keys.SPACE)
    assert button.get_attribute("aria-pressed") == "false"
    assert page.figure("#curves .plot")["names"] == before["names"][1:]
    page.click(button)
    assert page.figure("#curves .plot")["names"] == before["names"]


def test_a_heading_sorts_the_ranking(page):
    rows = "#ranking figure:not([hidden]) tbody tr th"
    ranked = page.shown(rows)
    heading = page.find("#ranking figure:not([hidden]) thead th:nth-child(2)")
    button = heading.find_element(By.CSS_SELECTOR, "button")
    assert heading.get_attribute("aria-sort") == "descending"
    page.click(button)
    assert heading.get_attribute("aria-sort") == "ascending"
    assert page.shown(rows) == ranked[::-1]
    button.send_keys(Keys.ENTER)
    assert heading.get_attribute("aria-sort") == "descending"
    assert page.shown(rows) == ranked
    # Names sort as text.
    page.click(page.find("#ranking figure:not([hidden]) thead th button"))
    assert [name[0] for name in page.shown(rows)] == ["<", "Q", "s"]
    assert len(page.all("#ranking figure:not([hidden]) th[aria-sort]")) == 1


def test_the_environment_changes_everywhere(page):
    small = page.all("#overview [data-choose]")
    assert [one.get_attribute("aria-pressed") for one in small] == ["true", "false"]
    page.click(small[1])
    assert [one.get_attribute("aria-pressed") for one in small] == ["false", "true"]
    assert Select(page.find("#environment")).first_selected_option.text == "Warehouse-v0"
    assert set(page.shown("h2 .where")) == {"Warehouse-v0"}
    assert len(page.all(".board:first-child [data-cell]")) == 100
    assert len(page.figure("#intervals")["names"]) == 3


def test_maps_go_through_the_training_and_tell_each_cell(page):
    slider, board = page.find("#progress"), page.all(".board")[1]
    assert slider.get_attribute("aria-valuetext") == "after 2,000 steps"
    last = board.get_attribute("innerHTML")
    slider.send_keys(Keys.HOME)
    label = page.find("#policies output").text
    assert slider.get_attribute("aria-valuetext") == label != "after 2,000 steps"
    assert page.all(".board")[1].get_attribute("innerHTML") != last
    slider.send_keys(Keys.END)
    optimum, *boards = page.all(".board")
    assert boards[0].get_attribute("innerHTML") == last
    # What is not optimal is marked.
    assert optimum.find_elements(By.CSS_SELECTOR, ".differs") == []
    for each in boards:
        marked = len(each.find_elements(By.CSS_SELECTOR, ".differs"))
        assert f"{11 - marked} of 11 cells" in each.text
    # The arrows go from cell to cell.
    told = page.find("#policies .cell")
    keys = page.all(".board svg")[1]
    keys.send_keys(Keys.ARROW_RIGHT)
    assert told.text.startswith("row 1, column 1: optimum 0.7442 (left)")
    keys.send_keys(*[Keys.ARROW_DOWN] * 4, *[Keys.ARROW_RIGHT] * 2)
    assert told.text.startswith("row 4, column 3: optimum 0.924 (down)")
    assert told.get_attribute("aria-live") == "polite"


def test_films_play_and_stop_and_stand_still_for_those_who_ask(page, report_study):
    screen = page.find(".films:not([hidden]) .screen")
    picture = screen.find_element(By.CSS_SELECTOR, "img")
    assert picture.get_attribute("src").startswith("data:image/gif")
    page.click(screen)
    assert screen.get_attribute("aria-pressed") == "false"
    assert picture.get_attribute("src").startswith("data:image/png")
    screen.send_keys(Keys.ENTER)
    assert picture.get_attribute("src").startswith("data:image/gif")
    page.load(report_study.page, prefers_reduced_motion="reduce")
    # Figures are drawn when they come near.
    assert page.all("#profiles .main-svg") == []
    page.run("document.querySelector('#profiles').scrollIntoView()")
    page.wait(lambda: page.all("#profiles .main-svg"))
    sources = [element.get_attribute("src")[:14] for element in page.all(".screen img")]
    assert set(sources) == {"data:image/png"}


def test_the_theme_follows_the_system_and_the_button(page):
    def theme():
        background = "getComputedStyle(document.body).backgroundColor"
        return page.run(f"return [document.documentElement.dataset.theme, {background}]")

    name, light = theme()
    assert name == "light"
    ink = page.figure("#curves .plot")["ink"]
    page.emulate("", {"prefers-color-scheme": "dark"})
    page.wait(lambda: theme()[0] == "dark")
    assert theme()[1] != light
    assert page.figure("#curves .plot")["ink"] != ink
    button = page.find("#theme")
    page.click(button)
    assert (button.text, theme()) == ("Theme: light", ["light", light])
    button.send_keys(Keys.ENTER)
    assert (button.text, theme()[0]) == ("Theme: dark", "dark")


@pytest.mark.parametrize("width", [1280, 720, 320])
def test_nothing_lies_beyond_the_edge_of_a_laptop_or_a_phone(browser, report_study, width):
    browser.load(report_study.page, width)
    browser.plots(5)
    for environment in (0, 1):
        browser.select("#environment", environment)
        time.sleep(0.3)
        browser.fits(width)
        for css in ("#ranking", "#comparison") if width > 700 else ():
            reach, room = browser.run(
                "const e = document.querySelector(arguments[0] + ' figure:not([hidden]) .scroll');"
                "return [e.scrollWidth, e.clientWidth]",
                css,
            )
            assert reach <= room


def test_verdicts_and_tables_to_take_along(page, report_study):
    saved = page.driver.execute_async_script(
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
    assert saved == [
        [
            f"small-b-bold-b-verdict.{markup}",
            verdicts_as(markup, report_study.analysis, "python compare.py 'a & b.yml'"),
        ]
        for markup in MARKUPS
    ]
    csv = page.run("return report.csv(document.querySelector('#ranking table'))").splitlines()
    assert csv[0].startswith('Agent,"Mean, over seeds",')
    assert sorted(line[:5] for line in csv[1:]) == ["</scr", "Q-lea", "sarsa"]
    # A label that a spreadsheet would run.
    guarded = page.run(
        """
        const table = document.createElement("table");
        table.innerHTML = "<thead><tr><th>a</th><th>b</th></tr></thead>" +
          "<tbody><tr><th>=1+1</th><td data-value='-2'>-2</td></tr></tbody>";
        return report.csv(table);
        """
    )
    assert guarded == "a,b\n'=1+1,-2\n"


def test_paper_has_every_environment_in_light_colours_and_loses_nothing(browser, report_study):
    """As it is printed from a dark screen."""
    dark = {"prefers-color-scheme": "dark"}
    browser.load(report_study.page, PAPER, prefers_color_scheme="dark")
    browser.plots(5)
    browser.emulate("print", dark)
    browser.wait(lambda: browser.all(".sheet"))
    # Ranking, learning curves, differences, policies, films, settings.
    assert browser.shown("h2 .where") == ["FrozenLake-v1", "Warehouse-v0"] * 6
    for css in (".sheet .plot .main-svg", ".sheet table", ".sheet .board", "h1", "#verdict .card"):
        rights = browser.run(
            "return [...document.querySelectorAll(arguments[0])]"
            ".filter((e) => e.getClientRects().length)"
            ".map((e) => e.getBoundingClientRect().right)",
            css,
        )
        assert rights, css
        assert max(rights) <= PAPER, css
    assert browser.all("details:not([open])") == []
    ink = browser.run("return getComputedStyle(document.querySelector('.sheet .xtick text')).fill")
    assert ink == "rgb(27, 31, 35)"
    # Afterwards the page is as before.
    browser.emulate("screen", {})
    browser.wait(lambda: not browser.all(".sheet"))
    assert set(browser.shown("h2 .where")) == {"FrozenLake-v1"}
    assert browser.find("#curves .controls").is_displayed()
    assert browser.all("details[open]") == []


# --- bandits, and a search ------------------------------------------------------------------------


def test_a_study_on_bandits(browser, do_study, tmp_path):
    places = ("BernoulliBandit-v0", "SegmentBandit-v0")
    specs = tuple(EnvironmentSpec(name, name, {"n_timesteps": 300}) for name in places)
    agents = tuple(AgentSpec(name, name, tuned=False) for name in ("thompson", "epsilon_greedy"))
    study = StudySpec("b", "Bandits", agents, specs, n_seeds=3, metric="regret")
    path = tmp_path / "report.html"
    write_report(Report(study_series(analyse(do_study(study, tmp_path))), "compare.py b.yml"), path)
    browser.load(path, 380)
    browser.plots(6)
    for environment in (1, 0):
        browser.select("#environment", environment)
        time.sleep(0.3)
        browser.fits(380)
    regret = browser.figure("#pull-regret")
    assert regret["axes"][:2] == ["pulls (log scale)", "log"]
    assert "Auer, for UCB1" in regret["names"]
    browser.choose("pull-axis", "linear")
    browser.choose("pull-spread", "runs")
    other = browser.figure("#pull-regret")
    assert (other["axes"][1], other["y"] != regret["y"]) == ("linear", True)
    browser.select("#environment", 1)
    last = browser.figure("#pull-posteriors")
    browser.select(".pick.context select", 1)
    casual = browser.figure("#pull-posteriors")
    assert casual["y"] != last["y"]
    browser.select(".pick.moment select", 0)
    first = browser.figure("#pull-posteriors")
    # A density that knows less is lower.
    assert max(v for y in first["y"] for v in y) < max(v for y in casual["y"] for v in y)
    browser.asks_nobody(path)


def test_the_page_of_a_search_draws_and_fits_a_telephone(browser, tuning_record, tmp_path):
    path = tmp_path / "report.html"
    write_tuning_page(tuning_record, path, "retest/report.html")
    browser.load(path, 390)
    browser.plots(3)
    assert len(browser.all(".js-plotly-plot")) == 3
    browser.fits(390)
    told = "Triangles at the edge lie beyond it. Failed: trial 4."
    assert told in browser.find("#history").text
    browser.asks_nobody(path)


# --- pages that play a training -------------------------------------------------------------------

ASKED = {
    "table": ("FrozenLake-v1", "double_qlearning", {"n_timesteps": 400, "initial_q": 0.5}),
    "rows": ("Hostile-v0", "qlearning", {"n_timesteps": 300}),
    "updates": ("FrozenLake-v1", "ppo", {"n_timesteps": 128, "n_steps": 64, "engine": "compiled"}),
    "prizes": ("MineMaze-v0", "value_iteration", {"n_timesteps": 64}),
    "tiles": ("MountainCar-v0", "semi_gradient_sarsa", {"n_timesteps": 50, "n_tiles": 2}),
}  # fmt: skip


class Hostile(TaxiEnv):
    action_names = ("<img src=x onerror=alert(1)>",) * 6


@pytest.fixture(scope="module")
def trainings(tmp_path_factory):
    """With a page of each: a table on a map, a hostile one without, a network, a planner, tiles."""
    folder = tmp_path_factory.mktemp("learning")
    gym.register("Hostile-v0", Hostile, max_episode_steps=100)
    done = {}
    try:
        for name, (env_id, algo, entry) in ASKED.items():
            kept = {"log_folder": folder / name, "watch_learning": folder / f"{name}.html"}
            common = {"seed": 0, "verbose": 0, "pictures": False, **kept}
            spec = TrainSpec(algo, env_id, split(entry), entry, **common)
            done[name] = prepare(spec, Console(quiet=True), {}, "")
            carry_out(done[name])
            title = f"{HOSTILE} on Hostile-v0" if name == "rows" else ""
            write_learning_page(spec, done[name].watch, spec.watch_learning, title)
    finally:
        del gym.registry["Hostile-v0"]
    return done


@pytest.fixture
def played(browser, trainings):
    """Loads one of these pages; the training that it shows."""

    def load(name, width=1280, **features):
        browser.load(trainings[name].spec.watch_learning, width, **features)
        browser.wait(lambda: browser.find("#moment").text)
        return trainings[name]

    return load


def fact(browser, name):
    return browser.run(
        """
        const names = [...document.querySelectorAll("#readout dt")];
        return names.find((dt) => dt.textContent === arguments[0])?.nextElementSibling.textContent;
        """,
        name,
    )


def table_on_page(browser):
    """The rows of the tables that are shown: their name and their numbers."""
    return {
        row.find_element(By.CSS_SELECTOR, "th").text: [
            cell.text for cell in row.find_elements(By.CSS_SELECTOR, "td")
        ]
        for row in browser.all("#rows tbody tr")
    }


def test_steps_are_played_forwards_and_back(browser, played):
    recorder = played("table").watch
    moment = browser.find("#moment")
    assert moment.text == "step 0 of 400"
    move = next(row for row in recorder.moves.rows if row["td_error"] != 0)
    number = int(move["step"])
    browser.run(
        "const s = document.getElementById('position'); s.value = arguments[0];"
        "s.dispatchEvent(new Event('input'))",
        number,
    )
    before = table_on_page(browser)
    browser.press(Keys.ARROW_RIGHT)
    assert float(fact(browser, "target")) == pytest.approx(move["target"], rel=1e-5)
    assert float(fact(browser, "TD error")) == pytest.approx(move["td_error"], rel=1e-3)
    assert fact(browser, "reward").startswith(f"{move['reward']:g}")
    change = recorder.changes.rows[recorder.changes.rows["step"] == number][0]
    assert fact(browser, "entry").endswith(f"{change['after']:.6g}")
    # The entry is marked in its row and on the map.
    for css in ("#rows .up, #rows .down", ".board .moved", ".board .agent"):
        assert len(browser.all(css)) == 1, css
    browser.press(Keys.ARROW_LEFT)
    assert table_on_page(browser) == before
    browser.press(Keys.END)
    assert moment.text.startswith("step 400 of 400")
    browser.press(Keys.HOME)
    assert moment.text == "step 0 of 400"
    assert browser.all(".board .moved") == []
    # It plays and pauses by the space bar.
    browser.press(Keys.HOME, "+", "+", "+", " ")
    assert browser.find("#play").get_attribute("aria-pressed") == "true"
    browser.wait(lambda: not moment.text.startswith("step 0 "))
    browser.press(" ")
    held = moment.text
    time.sleep(0.2)
    assert moment.text == held
    assert browser.find("#play").get_attribute("aria-pressed") == "false"


def test_at_the_end_the_page_holds_the_agents_table_and_hostile_names_are_text(browser, played):
    training = played("rows")
    browser.press(Keys.END)
    shown = table_on_page(browser)
    assert len(shown) >= 8
    for name, numbers in shown.items():
        row = training.model.policy.q_table[int(name.removeprefix("state "))]
        assert [float(text) for text in numbers] == pytest.approx(row.tolist(), rel=1e-3, abs=1e-9)
    assert len(browser.all(".board .cell")) == 500
    assert browser.driver.title == f"{HOSTILE} on Hostile-v0: learning"
    assert browser.find("h1").text == f"{HOSTILE} on Hostile-v0"
    assert fact(browser, "action") == "<img src=x onerror=alert(1)>"
    assert browser.all("main img") == []
    browser.asks_nobody(training.spec.watch_learning)


@pytest.mark.parametrize("name", ASKED)
def test_on_a_phone_it_has_large_buttons_with_names_and_no_sideways_scroll(browser, played, name):
    training = played(name, width=390)
    browser.press(Keys.END)
    browser.fits(390)
    # No figure stands letter below letter.
    assert all(figure.size["width"] >= 80 for figure in browser.all("#readout dd"))
    for button in browser.all(".controls button, .controls select"):
        if button.is_displayed():
            assert min(button.size.values()) >= 44
            assert button.text or button.get_attribute("aria-label")
    named = (
        "return [...document.querySelectorAll('svg')].every((e) => e.getAttribute('aria-label'))"
    )
    assert browser.run(named)
    browser.asks_nobody(training.spec.watch_learning)

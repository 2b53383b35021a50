"""All pages in Chromium: they draw, ask nobody for anything, and can be used without a mouse."""

import contextlib
import json
import os
import shutil
import time

import gymnasium as gym
import pytest
from gymnasium.envs.toy_text import TaxiEnv
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

from rl_yardstick.report.page.learning import write_learning_page
from rl_yardstick.report.page.tuning import write_tuning_page
from tests.report import made_up
from tests.report.made_up import HOSTILE

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
# A missing browser would leave the pages untested unseen, so that in CI it is a failure.
pytestmark = pytest.mark.skipif(
    "CI" not in os.environ and not (BROWSER and DRIVER),
    reason="needs Chromium and its chromedriver",
)
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run")
FLAGS += ("--disable-background-networking", "--disable-component-update", "--disable-sync")


class Browser:
    """What tests do with a page."""

    def __init__(self, profile):
        assert None not in (BROWSER, DRIVER), "install Chromium and chromedriver"
        options = webdriver.ChromeOptions()
        options.binary_location = BROWSER
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        self.driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
        self.run = self.driver.execute_script

    def load(self, path, width=1280):
        """With nothing in its logs and nothing remembered."""
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        for log in ("browser", "performance"):
            self.driver.get_log(log)
        self.driver.get(path.as_uri())
        with contextlib.suppress(Exception):
            self.run("localStorage.clear()")

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
              names: plot.data.map((trace) => trace.name).filter((name) => name),
              axis: plot.layout.xaxis.title?.text,
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
        # The browser's own start page may still be loading.
        browsers = ("data:", "blob:", "chrome:", "chrome-untrusted:")
        own = [url for url in asked if not url.startswith(browsers)]
        assert own == [path.as_uri()]

    def fits(self, width):
        assert self.run("return document.documentElement.scrollWidth") <= width


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    found = Browser(tmp_path_factory.mktemp("profile"))
    yield found
    found.driver.quit()


@pytest.fixture
def page(browser, report_study):
    """Freshly loaded in a wide window, all figures drawn."""
    browser.load(report_study.page)
    browser.plots(5)
    return browser


def test_it_loads_without_an_error_and_without_the_network(page, report_study):
    page.click(page.all("#verdict [data-choose]")[1])
    assert Select(page.find("#environment")).first_selected_option.text == "Warehouse-v0"
    assert set(page.shown("h2 .where")) == {"Warehouse-v0"}
    time.sleep(0.5)
    page.asks_nobody(report_study.page)
    # A hostile label is only text.
    assert page.driver.title == "Small & <b>bold</b>"
    assert page.all("main b") == []
    assert HOSTILE in page.find("#ranking").text
    assert HOSTILE in page.find(".dots").text


def test_all_that_reacts_can_be_reached_by_keyboard_and_says_its_state(page):
    # Curves: a choice of axes, and agents that are hidden in the legend.
    before = page.figure("#curves .plot")
    assert before["axis"] == "environment steps"
    page.find('input[name="by"][value="step"]').send_keys(Keys.ARROW_RIGHT)
    by_episode = page.figure("#curves .plot")
    assert by_episode["axis"] == "episodes"
    assert by_episode["x"] != before["x"]
    button = page.find("#curves .legend button")
    button.send_keys(Keys.SPACE)
    assert button.get_attribute("aria-pressed") == "false"
    assert page.figure("#curves .plot")["names"] == before["names"][1:]
    # The ranking is sorted by its headings.
    rows = "#ranking figure:not([hidden]) tbody tr th"
    ranked = page.shown(rows)
    heading = page.find("#ranking figure:not([hidden]) thead th:nth-child(2)")
    heading.find_element(By.CSS_SELECTOR, "button").send_keys(Keys.ENTER)
    assert heading.get_attribute("aria-sort") == "ascending"
    assert page.shown(rows) == ranked[::-1]
    # Maps go through the training, and tell each cell.
    slider = page.find("#progress")
    assert slider.get_attribute("aria-valuetext") == "after 2,000 steps"
    last = page.all(".board")[1].get_attribute("innerHTML")
    slider.send_keys(Keys.HOME)
    assert page.all(".board")[1].get_attribute("innerHTML") != last
    page.all(".board svg")[1].send_keys(Keys.ARROW_RIGHT)
    told = page.find("#policies .cell").text
    assert told.startswith("row 1, column 1: optimum 0.7442 (left)")
    # Films can be stopped.
    screen = page.find(".films:not([hidden]) .screen")
    picture = screen.find_element(By.CSS_SELECTOR, "img")
    assert picture.get_attribute("src").startswith("data:image/gif")
    screen.send_keys(Keys.ENTER)
    assert picture.get_attribute("src").startswith("data:image/png")


def test_nothing_lies_beyond_the_edge_of_a_phone(browser, report_study):
    browser.load(report_study.page, 320)
    browser.plots(5)
    for environment in (0, 1):
        browser.select("#environment", environment)
        time.sleep(0.3)
        browser.fits(320)


def test_the_page_of_a_search_draws_and_fits_a_telephone(browser, tmp_path):
    path = tmp_path / "report.html"
    write_tuning_page(made_up.tuning(), path, "retest/report.html")
    browser.load(path, 390)
    browser.plots(2)
    assert len(browser.all(".js-plotly-plot")) == 2
    browser.fits(390)
    told = "a triangle at its edge is a trial beyond it. Failed: trial 4."
    assert told in browser.find("#history").text
    browser.asks_nobody(path)


ASKED = {
    "rows": ("Hostile-v0", "qlearning", {"n_timesteps": 300}),
    "updates": ("FrozenLake-v1", "ppo", {"n_timesteps": 128, "n_steps": 64}),
}


class Hostile(TaxiEnv):
    action_names = ("<img src=x onerror=alert(1)>",) * 6


@pytest.fixture(scope="module")
def trainings(tmp_path_factory, watched):
    """What was recorded and the page: of a hostile table without a map, of a network."""
    folder = tmp_path_factory.mktemp("learning")
    gym.register("Hostile-v0", Hostile, max_episode_steps=100)
    done = {}
    try:
        for name, asked in ASKED.items():
            spec, watch = watched(*asked, seed=0)
            title = f"{HOSTILE} on Hostile-v0" if name == "rows" else ""
            write_learning_page(spec, watch, folder / f"{name}.html", title)
            done[name] = watch, folder / f"{name}.html"
    finally:
        del gym.registry["Hostile-v0"]
    return done


@pytest.fixture
def played(browser, trainings):
    """Loads one of these pages; what was recorded, and the page."""

    def load(name, width=1280):
        browser.load(trainings[name][1], width)
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


def test_steps_are_played_by_keyboard_and_hostile_names_are_text(browser, played):
    watch, _ = played("rows")
    moment, rows = browser.find("#moment"), watch.rows()["moves"]
    assert moment.text == "step 0 of 300"
    browser.press(Keys.ARROW_RIGHT)
    assert float(fact(browser, "target")) == pytest.approx(rows["target"][0], rel=1e-5)
    assert fact(browser, "reward").startswith(f"{rows['reward'][0]:g}")
    assert fact(browser, "action") == "<img src=x onerror=alert(1)>"
    browser.press("+", "+", "+", " ")
    assert browser.find("#play").get_attribute("aria-pressed") == "true"
    browser.wait(lambda: not moment.text.startswith("step 1 "))
    browser.press(" ", Keys.END)
    assert browser.find("#play").get_attribute("aria-pressed") == "false"
    # At the end the page holds the agent's table.
    shown = browser.all("#rows tbody tr")
    assert len(shown) >= 8
    for row in shown:
        state = int(row.find_element(By.CSS_SELECTOR, "th").text.removeprefix("state "))
        numbers = [float(cell.text) for cell in row.find_elements(By.CSS_SELECTOR, "td")]
        expected = watch.model.policy.q_table[state].tolist()
        assert numbers == pytest.approx(expected, rel=1e-3, abs=1e-9)
    assert browser.driver.title == f"{HOSTILE} on Hostile-v0: learning"
    assert browser.find("h1").text == f"{HOSTILE} on Hostile-v0"
    assert browser.all("main img") == []


@pytest.mark.parametrize("name", ASKED)
def test_on_a_phone_it_has_large_buttons_with_names_and_no_sideways_scroll(browser, played, name):
    _, path = played(name, width=390)
    browser.press(Keys.END)
    browser.fits(390)
    # No figure stands letter below letter.
    assert all(figure.size["width"] >= 80 for figure in browser.all("#readout dd"))
    for button in browser.all(".controls button, .controls select"):
        if button.is_displayed():
            assert min(button.size.values()) >= 44
            assert button.text or button.get_attribute("aria-label")
    assert all(picture.get_attribute("aria-label") for picture in browser.all("svg"))
    browser.asks_nobody(path)

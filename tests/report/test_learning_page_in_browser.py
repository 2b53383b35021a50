"""The page that plays a training, in a browser."""

import json
import time
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import carry_out, prepare
from report.page.learning import write_learning_page
from tests.report.browsing import find, find_all, needs_browser, resize, script_click, wait

pytestmark = needs_browser

HOSTILE_NAME = "Q</script><script>document.title='taken'</script>"


@pytest.fixture(scope="module")
def learning_pages(tmp_path_factory):
    """Pages of a table on a map, of a hostile one without, of a planner and of a network."""
    from gymnasium.envs.toy_text import TaxiEnv

    folder = tmp_path_factory.mktemp("learning")

    class Hostile(TaxiEnv):
        action_names = ("<img src=x onerror=alert(1)>",) * 6

    gym.register("Hostile-v0", Hostile, max_episode_steps=100)
    asked = {
        "table": ("FrozenLake-v1", "double_qlearning", {"n_timesteps": 400, "initial_q": 0.5}),
        "rows": ("Hostile-v0", "qlearning", {"n_timesteps": 300}),
        "map": ("FrozenLake-v1", "value_iteration", {"n_timesteps": 640}),
        "updates": (
            "FrozenLake-v1",
            "ppo",
            {"n_timesteps": 640, "n_steps": 32, "batch_size": 32, "engine": "compiled"},
        ),
        "prizes": ("MineMaze-v0", "value_iteration", {"n_timesteps": 64}),
        "tiles": ("MountainCar-v0", "semi_gradient_sarsa", {"n_timesteps": 50, "n_tiles": 2}),
    }
    try:
        trainings = {}
        for name, (env_id, algo, entry) in asked.items():
            spec = TrainSpec(
                algo,
                env_id,
                split(entry),
                entry,
                seed=0,
                verbose=0,
                pictures=False,
                log_folder=folder / name,
                watch_learning=folder / f"{name}.html",
            )
            trainings[name] = prepare(spec, Console(quiet=True), {}, "")
            carry_out(trainings[name])
            shown = replace(spec, algo=HOSTILE_NAME) if name == "rows" else spec
            write_learning_page(shown, trainings[name].watch, spec.watch_learning)
    finally:
        del gym.registry["Hostile-v0"]
    return trainings


@pytest.fixture
def played(browser, learning_pages):
    """Loads one of these pages; the training that it shows."""

    def load(name, width=1280, scheme="light", moves="no-preference"):
        features = [
            {"name": "prefers-color-scheme", "value": scheme},
            {"name": "prefers-reduced-motion", "value": moves},
        ]
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        resize(browser, width)
        browser.get_log("browser")
        browser.get_log("performance")
        browser.get(learning_pages[name].spec.watch_learning.as_uri())
        wait(browser, lambda: find(browser, "#moment").text)
        return learning_pages[name]

    yield load
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def press(browser, *keys):
    find(browser, "body").send_keys(*keys)


def fact(browser, name):
    return browser.execute_script(
        """
        const names = [...document.querySelectorAll("#readout dt")];
        return names.find((dt) => dt.textContent === arguments[0])?.nextElementSibling.textContent;
        """,
        name,
    )


def table_on_page(browser):
    """The rows of the tables that are shown: their name and their numbers."""
    rows = find_all(browser, "#rows tbody tr")
    return {
        row.find_element(By.CSS_SELECTOR, "th").text: [
            cell.text for cell in row.find_elements(By.CSS_SELECTOR, "td")
        ]
        for row in rows
    }


def test_steps_are_played_forwards_and_back(browser, played):
    recorder = played("table").watch
    assert find(browser, "#moment").text == "step 0 of 400"
    move = next(row for row in recorder.moves.rows if row["td_error"] != 0)
    number = int(move["step"])
    browser.execute_script(
        "const s = document.getElementById('position'); s.value = arguments[0];"
        "s.dispatchEvent(new Event('input'))",
        number,
    )
    before = table_on_page(browser)
    press(browser, Keys.ARROW_RIGHT)
    assert float(fact(browser, "target")) == pytest.approx(move["target"], rel=1e-5)
    assert float(fact(browser, "TD error")) == pytest.approx(move["td_error"], rel=1e-3)
    assert fact(browser, "reward").startswith(f"{move['reward']:g}")
    change = recorder.changes.rows[recorder.changes.rows["step"] == number][0]
    assert fact(browser, "entry").endswith(f"{change['after']:.6g}")
    # The entry is marked in its row and on the map.
    assert len(find_all(browser, "#rows .up, #rows .down")) == 1
    assert len(find_all(browser, ".board .moved")) == 1
    assert len(find_all(browser, ".board .agent")) == 1
    press(browser, Keys.ARROW_LEFT)
    assert table_on_page(browser) == before
    press(browser, Keys.END)
    assert find(browser, "#moment").text.startswith("step 400 of 400")
    press(browser, Keys.HOME)
    assert find(browser, "#moment").text == "step 0 of 400"
    assert find_all(browser, ".board .moved") == []


def test_at_the_end_the_page_holds_the_agents_table(browser, played):
    training = played("rows")
    press(browser, Keys.END)
    table = training.model.policy.q_table
    shown = table_on_page(browser)
    assert len(shown) >= 8
    for name, numbers in shown.items():
        row = table[int(name.removeprefix("state "))]
        assert [float(text) for text in numbers] == pytest.approx(row.tolist(), rel=1e-3, abs=1e-9)
    assert len(find_all(browser, ".board .cell")) == 500


def test_it_jumps_to_episodes_and_to_large_errors(browser, played):
    moves = played("table").watch.moves.rows
    ends = np.flatnonzero(moves["end"])
    press(browser, "n")
    assert find(browser, "#moment").text.startswith(f"step {ends[0] + 2} of")
    assert fact(browser, "episode").startswith("2,")
    press(browser, "n")
    assert fact(browser, "episode").startswith("3,")
    press(browser, "p")
    assert fact(browser, "episode").startswith("2,")
    press(browser, Keys.HOME)
    sizes = np.abs(moves["td_error"])
    large = max(np.sort(sizes)[int(0.95 * len(sizes))], np.nextafter(0, 1))
    script_click(browser, find(browser, "#next-large"))
    first = int(np.flatnonzero(sizes >= large)[0])
    assert find(browser, "#moment").text.startswith(f"step {first + 1} of")


def test_it_plays_and_pauses_by_the_space_bar(browser, played):
    played("table")
    press(browser, "+", "+", "+")
    press(browser, " ")
    assert find(browser, "#play").get_attribute("aria-pressed") == "true"
    wait(browser, lambda: not find(browser, "#moment").text.startswith("step 0 "))
    press(browser, " ")
    held = find(browser, "#moment").text
    time.sleep(0.2)
    assert find(browser, "#moment").text == held
    assert find(browser, "#play").get_attribute("aria-pressed") == "false"


def test_what_has_no_table_is_shown_at_each_evaluation(browser, played):
    recorder = played("map").watch
    press(browser, Keys.END)
    assert find(browser, "#moment").text == f"evaluation {recorder.n_units} of {recorder.n_units}"
    value = recorder.moments.rows["values"][-1][0]
    assert float(fact(browser, "return of the policy, computed").split()[0]) == pytest.approx(
        value, rel=1e-3
    )
    arrows = [path.get_attribute("d") for path in find_all(browser, ".board .arrow")]
    assert sum(bool(arrow) for arrow in arrows) == recorder.evaluator.model.reachable.sum()


def test_a_network_is_shown_at_each_update_with_what_it_logs(browser, played):
    recorder = played("updates").watch
    assert find(browser, "#moment").text == "before the training"
    assert fact(browser, "train/loss") == "\N{EN DASH}"
    press(browser, Keys.ARROW_RIGHT)
    assert find(browser, "#moment").text == "update 1 of 20"
    row = recorder.moments.rows[1]
    assert float(fact(browser, "train/loss")) == pytest.approx(row["loss"], rel=1e-3)
    assert float(fact(browser, "train/value_loss")) == pytest.approx(row["value_loss"], rel=1e-3)
    assert fact(browser, "environment steps") == "32"
    assert fact(browser, "exploration") is None
    press(browser, Keys.END)
    assert find(browser, "#moment").text == "update 20 of 20"


def test_a_hostile_environment_is_only_text_and_nobody_is_asked(browser, played):
    played("rows")
    press(browser, Keys.END)
    assert browser.title == f"{HOSTILE_NAME} on Hostile-v0: learning"
    assert find(browser, "h1").text == f"{HOSTILE_NAME} on Hostile-v0"
    assert fact(browser, "action") == "<img src=x onerror=alert(1)>"
    assert find_all(browser, "main img") == []
    assert browser.get_log("browser") == []
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    ]
    assert len([url for url in asked if not url.startswith(("data:", "blob:"))]) == 1


def test_a_table_that_diverges_is_shown_as_it_is(browser, learning_pages, tmp_path):
    training = learning_pages["table"]
    recorder, path = training.watch, tmp_path / "page.html"
    rows = recorder.changes.rows
    last = rows["step"] == rows["step"][-1]
    kept = rows["after"].copy()
    rows["after"][last] = np.nan
    rows["after"][np.flatnonzero(~last)[-1]] = np.inf
    try:
        write_learning_page(training.spec, recorder, path)
    finally:
        rows["after"] = kept
    resize(browser, 1280)
    browser.get(path.as_uri())
    wait(browser, lambda: find(browser, "#moment").text)
    press(browser, Keys.END)
    words = find(browser, "#board").text.split()
    assert {"nan", "\N{INFINITY}"} <= set(words)
    assert find(browser, "#legend").text.count("from 0") == 1
    assert browser.get_log("browser") == []


def test_of_prizes_each_set_has_its_map(browser, played):
    evaluator = played("prizes").watch.evaluator
    press(browser, Keys.END)
    layers = Select(find(browser, "#layer"))
    assert layers.first_selected_option.text == "none"
    n_cells = evaluator.model.n_states // evaluator.layout.n_layers
    for option, layer in zip(layers.options, range(evaluator.layout.n_layers), strict=True):
        layers.select_by_value(option.get_attribute("value"))
        arrows = [path.get_attribute("d") for path in find_all(browser, ".board .arrow")]
        reached = evaluator.model.reachable[layer * n_cells : (layer + 1) * n_cells]
        assert 0 < sum(map(bool, arrows)) <= reached.sum()


@pytest.mark.parametrize("name", ["table", "rows", "map", "updates", "prizes", "tiles"])
def test_on_a_phone_it_has_large_buttons_and_no_sideways_scroll(browser, played, name):
    played(name, width=390)
    press(browser, Keys.END)
    root = "document.documentElement"
    assert browser.execute_script(f"return {root}.scrollWidth <= {root}.clientWidth")
    assert browser.get_log("browser") == []
    # No figure stands letter below letter.
    assert all(figure.size["width"] >= 80 for figure in find_all(browser, "#readout dd"))
    for button in find_all(browser, ".controls button, .controls select"):
        if button.is_displayed():
            assert min(button.size.values()) >= 44
            assert button.text or button.get_attribute("aria-label")


def test_dark_and_light_and_little_motion(browser, played):
    paper = "return getComputedStyle(document.body).backgroundColor"
    played("table", scheme="light")
    light = browser.execute_script(paper)
    assert find(browser, "#speed").get_attribute("value") == "4"
    played("table", scheme="dark", moves="reduce")
    assert browser.execute_script(paper) != light
    assert find(browser, "#speed").get_attribute("value") == "1"
    named = (
        "return [...document.querySelectorAll('svg')].every((e) => e.getAttribute('aria-label'))"
    )
    assert browser.execute_script(named)

"""What tests do with a page in Chromium."""

import os
import shutil

import pytest
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

BROWSER, DRIVER = (
    shutil.which("chromium") or shutil.which("google-chrome"),
    shutil.which("chromedriver"),
)
# A missing browser would leave the page untested unseen, so that in CI it is a failure.
needs_browser = pytest.mark.skipif(
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
PATIENCE = 30  # seconds


def resize(browser, width):
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def wait(browser, condition):
    WebDriverWait(browser, PATIENCE, 0.1).until(lambda _: condition())


def has_scripts(browser):
    """Whether the page can be used: its scripts are unpacked after it is there."""
    return browser.execute_script("return typeof report !== 'undefined'")


def plots(browser):
    """How many figures are there, those drawn too that nobody has come near yet."""
    if not has_scripts(browser):
        return 0
    browser.execute_script("report.drawAll()")
    return browser.execute_script("return document.querySelectorAll('.plot .main-svg').length")


def find(browser, css):
    return browser.find_element(By.CSS_SELECTOR, css)


def find_all(browser, css):
    return browser.find_elements(By.CSS_SELECTOR, css)


def script_click(browser, element):
    """A click that does not care what the sticky bar lies over."""
    browser.execute_script("arguments[0].click()", element)

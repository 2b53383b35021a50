import random

import pytest


@pytest.fixture(autouse=True)
def seeds_are_drawn_alike(request, monkeypatch):
    """A command without --seed draws one: what fails once has to fail again."""
    drawing = random.Random(request.node.nodeid)  # noqa: S311  # to be repeated, not kept secret
    monkeypatch.setattr("secrets.randbelow", drawing.randrange)


@pytest.fixture
def pictures():
    """For tests that look at what a run draws."""


@pytest.fixture(autouse=True)
def no_pictures_elsewhere(request, monkeypatch):
    """They take most of a short run."""
    if "pictures" not in request.fixturenames:
        monkeypatch.setattr("rl_yardstick.pipeline.training.draw", lambda *_: None)


@pytest.fixture
def type_command(monkeypatch, typed, tmp_path):
    """As `typed`, inside an empty folder."""
    monkeypatch.chdir(tmp_path)
    return typed

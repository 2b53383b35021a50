import random

import pytest


@pytest.fixture(autouse=True)
def seeds_are_drawn_alike(request, monkeypatch):
    """A command without --seed draws one: what fails once has to fail again."""
    drawing = random.Random(request.node.nodeid)  # noqa: S311  # to be repeated, not kept secret
    monkeypatch.setattr("secrets.randbelow", drawing.randrange)


@pytest.fixture(autouse=True)
def in_an_empty_folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def pictures():
    """For tests that look at what a run draws."""


@pytest.fixture(autouse=True)
def no_pictures_elsewhere(request):
    if "pictures" not in request.fixturenames:
        request.getfixturevalue("quick_runs")

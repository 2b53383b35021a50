"""What tests of settings need."""

import copy
from functools import cache

import pytest

from pipeline.settings import hyperparams
from pipeline.settings.yaml import read_yaml

_parsed = cache(read_yaml)


@pytest.fixture
def files_parsed_once(monkeypatch):
    """For tests of every entry of a file: to parse it takes longer than all that is tested."""
    monkeypatch.setattr(hyperparams, "read_yaml", lambda path: copy.deepcopy(_parsed(path)))

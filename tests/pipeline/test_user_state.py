"""What the user's modules keep outside of objects, and what is said where nothing can be kept."""

import sys
from dataclasses import replace

import pytest

from pipeline import state_files
from pipeline.runs import Run
from pipeline.state_saver import StateSaver, put_back, user_state
from pipeline.states import Pickled, pickled, unpickled
from pipeline.unfinished_runs import StateKeeping
from pipeline.user_modules import import_typed

SOURCE = """
import random
from typing import TypeVar

T = TypeVar("T")
steps = 0
seen = []
rng = random.Random(1)

class Thing:
    made = 0
    names = ["a"]

    def step(self):
        global steps
        steps += 1
        seen.append(rng.random())
        Thing.made += 1
        self.names.append("b")
"""


@pytest.fixture
def things(tmp_path, monkeypatch):
    path = tmp_path / "things_with_globals.py"
    path.write_text(SOURCE)
    monkeypatch.setattr(sys, "path", [*sys.path])
    modules = import_typed([str(path)])
    yield modules, sys.modules["things_with_globals"]
    del sys.modules["things_with_globals"]


def frozen(modules):
    """What modules hold now, whatever becomes of it."""
    held = pickled({"it": modules})
    memories = [memory.copy() for memory in held.memories]
    return replace(held, pickled=bytes(held.pickled), memories=memories)


def test_globals_and_attributes_of_classes_go_back(things):
    modules, module = things
    thing = module.Thing()
    thing.step()
    saved = frozen(user_state(modules))
    seen = list(module.seen)
    thing.step()
    after = list(module.seen)
    put_back(modules, unpickled(saved, {"it": user_state(modules)})["it"])
    assert (module.steps, module.Thing.made, module.Thing.names) == (1, 1, ["a", "b"])
    assert module.seen == seen
    thing.step()
    assert module.seen == after
    assert module.Thing is type(thing)


def test_what_imports_and_remembers_is_no_obstacle(tmp_path, monkeypatch):
    source = """
import random
from functools import lru_cache
from numpy import mean
from torch import tanh

draw = random.Random(1).random

@lru_cache
def double(x):
    return 2 * x

class Thing:
    @lru_cache
    def triple(self, x):
        return 3 * x
"""
    path = tmp_path / "things_that_remember.py"
    path.write_text(source)
    monkeypatch.setattr(sys, "path", [*sys.path])
    modules = import_typed([str(path)])
    module = sys.modules["things_that_remember"]
    assert pickled({"it": user_state(modules)}).lost == []
    module.double(1)
    module.Thing.triple(None, 1)
    module.draw()
    saved = frozen(user_state(modules))
    assert [line.partition("]")[2] for line in saved.lost] == ["['double']", "['triple']"]
    after = module.draw()
    put_back(modules, unpickled(saved, {"it": user_state(modules)})["it"])
    assert module.draw() == after
    assert module.double(1) == 2
    del sys.modules["things_that_remember"]


def test_what_is_installed_is_left_alone():
    assert user_state(import_typed(["json"])) == {}


def saver_of(tmp_path, monkeypatch):
    told = []
    saver = StateSaver(Run(tmp_path, ""), StateKeeping(), told.append)
    saver.model = type("Model", (), {"num_timesteps": 0})()
    return saver, told


def test_a_disk_that_stays_full_is_told_once(tmp_path, monkeypatch):
    saver, told = saver_of(tmp_path, monkeypatch)

    def write(self):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(StateSaver, "_write", write)
    for _ in range(3):
        saver.save()
    assert len(told) == 1
    assert told[0].endswith("No space left on device")
    assert not saver.is_off


def test_without_memory_for_a_state_training_goes_on(tmp_path, monkeypatch):
    saver, told = saver_of(tmp_path, monkeypatch)

    def write(self):
        raise MemoryError

    monkeypatch.setattr(StateSaver, "_write", write)
    saver.save()
    saver.save()
    assert told == ["no state was saved: there is no memory left for it"]


def test_a_user_without_a_home_keeps_no_states(tmp_path, monkeypatch):
    saver, told = saver_of(tmp_path, monkeypatch)

    def no_home(_):
        raise FileNotFoundError("the user has no home folder")

    monkeypatch.setattr(state_files, "user_key", no_home)

    def write(self):
        state_files.save_state(tmp_path / "state", 1, Pickled(b"", (), ()), {})

    monkeypatch.setattr(StateSaver, "_write", write)
    saver.save()
    assert len(told) == 1
    assert "the user has no home folder" in told[0]
    assert saver.is_off
    assert not (tmp_path / "state").exists()

"""Libraries are imported without the garbage collector, which is back afterwards."""

import builtins
import gc
from types import SimpleNamespace

import pytest
import torch as th

from pipeline.library_loading import load_for_optimizer, loading_libraries


@pytest.fixture
def collector():
    before = gc.isenabled()
    yield
    (gc.enable if before else gc.disable)()


@pytest.mark.usefixtures("collector")
@pytest.mark.parametrize("was_on", [True, False])
def test_the_collector_is_as_it_was(was_on):
    (gc.enable if was_on else gc.disable)()
    with loading_libraries():
        assert not gc.isenabled()
    assert gc.isenabled() == was_on


@pytest.fixture
def imported(monkeypatch):
    """What is imported, and whether garbage was looked for meanwhile."""
    found, load = [], builtins.__import__

    def noted(name, *args):
        if name == "torch._dynamo":
            found.append(gc.isenabled())
        return load(name, *args)

    monkeypatch.setattr(builtins, "__import__", noted)
    return found


@pytest.mark.usefixtures("collector")
@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"optimizer": "Adam"}, [False]),
        ({"optimizer": "Adam", "engine": "library"}, [False]),
        ({"optimizer": "Adam", "engine": "compiled"}, []),
        ({"optimizer": "Adam", "engine": "auto"}, []),
        ({"optimizer": None}, []),
        ({"engine": "compiled"}, []),
    ],
)
def test_only_what_steps_an_optimizer_loads_what_that_needs(imported, fields, expected):
    gc.enable()
    model = SimpleNamespace(policy=SimpleNamespace(optimizer=fields.get("optimizer")))
    if "engine" in fields:
        model.engine = fields["engine"]
    load_for_optimizer(model)
    assert imported[:1] == expected  # which imports parts of itself by that name


def test_optimizers_import_it_still(imported):
    weight = th.nn.Parameter(th.zeros(1))
    th.optim.Adam([weight]).step()
    assert imported, "if not, there is nothing to load beforehand any more"

"""Libraries are imported without the garbage collector, which is back afterwards."""

import builtins
import gc
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch as th

from pipeline import loading_libraries
from pipeline.preparation import load_for_optimizer


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


COMPILED_TRAINING = """
import sys
from agents import load_algorithm
model = load_algorithm("ppo")("MlpPolicy", "CartPole-v1", n_steps=32, engine="{engine}")
model.learn(64)
model.save(sys.argv[1])
load_algorithm("ppo").load(sys.argv[1])
print("torch._dynamo" in sys.modules)
import torch
torch._dynamo.reset()
model.policy.optimizer.zero_grad()
kept_out = getattr(torch.optim.Optimizer.zero_grad.__wrapped__, "__dynamo_disable")
print(getattr(kept_out, "func", None) is None)
"""


@pytest.mark.parametrize(("engine", "imported"), [("compiled", False), ("library", True)])
def test_compiled_networks_do_without_pytorchs_compiler(tmp_path, engine, imported):
    program = COMPILED_TRAINING.format(engine=engine)
    command = [sys.executable, "-c", program, str(tmp_path / "model")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    # Once somebody has imported it, methods are kept out of it as ever.
    assert done.stdout.splitlines()[-2:] == [str(imported), "True"]


def test_optimizers_import_it_still(imported):
    weight = th.nn.Parameter(th.zeros(1))
    th.optim.Adam([weight]).step()
    assert imported, "if not, there is nothing to load beforehand any more"

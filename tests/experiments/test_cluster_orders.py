"""Orders travel as plain data, and arrive as they were."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.child_processes import NO_LIMITS
from experiments.cluster.working import Probe, RunOrder
from experiments.plan import plan
from experiments.run_limits import RunLimits
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec, find_study, read_study
from pipeline.settings.hyperparams import split
from pipeline.user_modules import UserModule

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.integers() | st.sampled_from(["1e-4", "yes", "0"]), inner, max_size=3)
    ),
    max_leaves=8,
)


def order_of(planned, limits=NO_LIMITS):
    return RunOrder(
        planned, "compare.py 'x y'", limits, Probe(Path("/h"), Path("r"), "n", "c"), "t", "v"
    )


def runs_of(path):
    lake = EnvironmentSpec("the lake", "FrozenLake-v1", {"n_timesteps": 20})
    study = StudySpec("s", "S", (AgentSpec("a: b", "qlearning"),), (lake,), n_seeds=1)
    return plan(study, Path(path))


@settings(deadline=None)
@given(st.dictionaries(st.text(st.characters(codec="ascii"), min_size=1), VALUES, max_size=4))
def test_whatever_an_environment_is_given_arrives_as_it_was(arguments):
    planned = runs_of("logs")[0]
    raw = {**planned.spec.saved_hyperparams, "env_kwargs": arguments}
    spec = replace(planned.spec, hyperparams=split(raw), saved_hyperparams=raw)
    order = order_of(replace(planned, spec=spec))
    assert RunOrder.unpacked(order.packed()) == order


@pytest.mark.parametrize("name", ["library-vs-hand-rolled", "bandit-testbed"])
def test_the_orders_of_a_study_arrive_as_they_were(name):
    for planned in plan(read_study(find_study(name)), Path("logs"))[::50]:
        order = order_of(planned.read(), RunLimits(math.inf, 10**9))
        received = RunOrder.unpacked(order.packed())
        assert received.planned == replace(planned)
        assert replace(received, planned=order.planned) == order


def test_modules_and_folders_arrive():
    planned = runs_of("a b/logs")[0]
    modules = (UserModule("./my envs.py", "my_envs", "/x/my envs.py"), UserModule("gym", "gym"))
    spec = replace(
        planned.spec,
        user_modules=modules,
        gym_packages=("my_envs", "gym"),
        tensorboard_log=Path("tb"),
        trained_agent=Path("a.zip"),
    )
    order = order_of(replace(planned, spec=spec))
    assert RunOrder.unpacked(order.packed()) == order


def test_an_order_holds_no_code(tmp_path):
    mark = tmp_path / "mark"
    content = order_of(runs_of("logs")[0]).packed()
    content = content.replace(
        b"command:", f"x: !!python/object/apply:os.mkdir ['{mark}']\ncommand:".encode()
    )
    with pytest.raises(yaml.constructor.ConstructorError):
        RunOrder.unpacked(content)
    assert not mark.exists()

"""Settings that a library cannot work with end a training in one line, and no bug is hidden."""

import json
import types
from contextlib import nullcontext

import pytest
import torch as th

from pipeline.failures import LibraryError, blame_settings

MODEL = types.SimpleNamespace(num_timesteps=1234)


def test_the_step_and_the_line_of_the_library_are_named(type_in_own_folder, own_folder):
    code, _, said = type_in_own_folder(
        *("train.py", "--env", "FrozenLake-v1", "--algo", "ppo", "-n", "64", "--verbose", "0"),
        *("-params", "clip_range:1e308", "n_steps:32", "batch_size:32", "n_envs:1"),
    )
    assert (code, said.count("\n")) == (2, 1)
    assert "ppo at step 32: value cannot be converted to type float without overflow (" in said
    record = next((own_folder / "logs").rglob("run.json"))
    assert json.loads(record.read_text(encoding="utf-8"))["state"] == "failed"


CODE = """
def of_torch(): th.nn.Linear(2, 2)(th.zeros(3))
def of_itself(): [].pop()
def of_memory(): raise RuntimeError("DefaultCPUAllocator: can't allocate memory")
"""


@pytest.mark.parametrize(
    ("module", "function", "is_blamed"),
    [
        ("agents.library", "of_torch", True),
        ("agents.library", "of_itself", False),
        ("torch.nn", "of_itself", True),
        ("torch.nn", "of_memory", False),
        ("someones_environment", "of_torch", False),
    ],
)
def test_only_what_went_through_no_code_of_the_users_is_blamed(module, function, is_blamed):
    names = {"__name__": module, "th": th}
    exec(CODE, names)  # noqa: S102  # ours
    try:
        names[function]()
    except (RuntimeError, IndexError) as error:
        # The first line is this file's, where that of a training is one of ours.
        mistake = error.with_traceback(error.__traceback__.tb_next)
    words = r"^dqn at step 1,234: .* \((torch, .+\.py|torch, <string>):\d+\)$"
    with pytest.raises(LibraryError, match=words) if is_blamed else nullcontext():
        blame_settings("dqn", MODEL, mistake)

"""A run that meets nan, infinity or settings that no library takes fails and says where."""

import io
import json
import math
import types
import zipfile
from contextlib import nullcontext
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from agents.bandits.tables import BanditPolicy
from experiments.bandits import _check_rewards
from pipeline.callbacks import NumberWatch
from pipeline.failures import LibraryError, blame_settings
from pipeline.finite_numbers import NotFiniteError, check_model, check_rows, is_finite


class Broken(gym.Env):
    """Episodes of ten steps, in one of which ``what`` is ``value``."""

    def __init__(self, what="", value=math.nan, at=25, kind="box", continuous=False):
        self.what, self.value, self.at, self.kind = what, value, at, kind
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = {
            "box": box,
            "dict": spaces.Dict({"eye": box}),
            "discrete": spaces.Discrete(3),
        }[kind]
        self.action_space = spaces.Box(-1, 1, (1,)) if continuous else spaces.Discrete(2)
        self.steps = 0

    def _observation(self, broken):
        if self.kind == "discrete":
            return self.steps % 3
        seen = np.array([0.5, self.value if broken else 1.0], dtype=np.float32)
        return {"eye": seen} if self.kind == "dict" else seen

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observation(self.what == "reset" and self.steps >= self.at), {}

    def step(self, action):
        self.steps += 1
        due = self.steps == self.at
        reward = self.value if due and self.what == "reward" else 1.0
        obs = self._observation(due and self.what == "obs")
        return obs, reward, self.steps % 10 == 0, False, {}


@pytest.fixture(scope="module", autouse=True)
def _registered():
    gym.register("Broken-v0", entry_point=Broken, max_episode_steps=20)
    yield
    del gym.registry["Broken-v0"]


@pytest.fixture
def train_on_broken(type_in_own_folder, own_folder):
    def train(algo, kwargs, *flags):
        code, _, said = type_in_own_folder(
            *("train.py", "--env", "Broken-v0", "--algo", algo, "-n", "60", "--seed", "0"),
            *("--eval-freq", "20", "--eval-episodes", "1", "--verbose", "0", "--env-kwargs"),
            *(f"{key}:{value}" for key, value in {"what": "nothing", **kwargs}.items()),
            *flags,
        )
        folder = own_folder / "logs" / algo / "Broken-v0_1"
        return code, said, folder, json.loads((folder / "run.json").read_text(encoding="utf-8"))

    return train


PPO = ("-params", "n_steps:8", "batch_size:8", "n_epochs:1")
STEP = "reward of environment 0 at step 25 is nan"
# Agent, environment, further flags, and the line.
AT_25 = "observation of environment 0 at step 25 is nan"
CASES = {
    "a table": ("qlearning", {"what": "reward", "kind": "discrete"}, (), STEP),
    "a network": ("ppo", {"what": "reward"}, PPO, STEP),
    "a buffer": ("dqn", {"what": "obs"}, (), AT_25),
    "infinity": ("dqn", {"what": "obs", "value": -math.inf}, (), AT_25.replace("nan", "-inf")),
    "no single precision": (
        "td3",
        {"what": "reward", "value": 1e39, "continuous": True},
        (),
        "reward of environment 0 at step 25 is inf",
    ),
    "by name": ("ppo", {"what": "obs", "kind": "dict"}, PPO, AT_25.replace("n of", "n 'eye' of")),
    "before a reset": (
        "dqn",
        {"what": "obs", "at": 20},
        (),
        "last observation of an episode of e",
    ),
    "after a reset": ("ppo", {"what": "reset", "at": 20}, PPO, AT_25.replace("25", "20")),
    "at the start": ("dqn", {"what": "reset", "at": 0}, (), "observation of environment 0 at ste"),
    "whole episodes": ("ars", {"what": "reward"}, (), STEP),
    "several": ("ppo", {"what": "reward"}, (*PPO, "n_envs:2"), STEP.replace("25", "50")),
    "statistics": ("ppo", {"what": "obs"}, (*PPO, "normalize:true"), AT_25),
    "evaluation sees": (
        "dqn",
        {},
        ("--eval-env-kwargs", "what:obs", "at:15"),
        "observation of environment 0 in the evaluation at step 40 is nan",
    ),
    "evaluation counts": (
        "dqn",
        {},
        ("--eval-env-kwargs", "what:reward", "at:15"),
        "return in the evaluation at step 40 is nan",
    ),
}


@pytest.mark.filterwarnings("ignore:.*(NaN|overflow|invalid value|not within)")
@pytest.mark.parametrize(("algo", "kwargs", "flags", "line"), CASES.values(), ids=CASES)
def test_a_run_fails_at_the_first_number_that_is_none(train_on_broken, algo, kwargs, flags, line):
    code, said, folder, info = train_on_broken(algo, kwargs, *flags)
    assert code == 2
    assert line in said
    assert said.count("\n") == 1
    assert info["state"] == "failed"
    assert line in info["reason"]
    assert not (folder / "Broken-v0.zip").exists()
    assert ("keeps best_model.zip" in said) == (folder / "best_model.zip").exists()


@pytest.mark.parametrize(
    ("algo", "flags"), [("a2c", ()), ("dqn", ("learning_starts:4", "batch_size:4"))]
)
def test_weights_that_are_none_are_never_saved(train_on_broken, algo, flags):
    code, said, folder, info = train_on_broken(
        algo, {}, "--save-freq", "10", "-params", "learning_rate:1e36", "max_grad_norm:1e30", *flags
    )
    assert (code, info["state"]) == (2, "failed")
    assert "train/" in said or "of the agent at step" in said
    assert not (folder / "Broken-v0.zip").exists()
    for path in folder.glob("*.zip"):
        with zipfile.ZipFile(path) as archive:
            weights = th.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)
        assert all(th.isfinite(tensor).all() for tensor in weights.values())


@given(
    arrays.arrays(
        st.sampled_from([np.float64, np.float32, np.float16, np.int64, np.uint8, np.bool_]),
        arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
    )
)
def test_the_quick_look_is_numpys(values):
    assert is_finite(values) == bool(np.isfinite(values).all())
    # Large numbers add up to no infinity.
    assert is_finite(np.array([1e300, -1e300]))
    assert is_finite(np.array([3e38], dtype=np.float32))


def test_the_environment_is_named():
    rewards = np.array([1.0, 2.0, np.nan, np.inf])
    with pytest.raises(NotFiniteError, match=r"^reward of environment 2 at step 9 is nan$"):
        check_rows(rewards, "reward", "at step 9")


def agent(**parts):
    policy = th.nn.Linear(2, 2)
    return SimpleNamespace(
        policy=policy, num_timesteps=1234, get_vec_normalize_env=lambda: None, **parts
    )


def test_a_layer_is_named():
    model = agent()
    check_model(model)
    with th.no_grad():
        model.policy.bias[1] = -th.inf
    with pytest.raises(NotFiniteError, match=r"^a value in bias of the agent at step 1,234 is -"):
        check_model(model)


@pytest.mark.parametrize("name", ["obs_rms", "ret_rms"])
def test_statistics_are_named(name):
    fine = SimpleNamespace(mean=np.zeros(2), var=np.ones(2))
    broken = SimpleNamespace(mean=np.zeros(2), var=np.array([1.0, np.inf]))
    model = agent()
    statistics = SimpleNamespace(obs_rms={"eye": fine}, ret_rms=fine)
    model.get_vec_normalize_env = lambda: statistics
    check_model(model)
    setattr(statistics, name, {"eye": broken} if name == "obs_rms" else broken)
    with pytest.raises(NotFiniteError, match=f"{name} of VecNormalize.*'variance'.* is inf"):
        check_model(model)


@pytest.mark.parametrize(
    ("seen", "line"),
    [
        ({"actions": np.array([[np.nan]])}, "action of environment 0 at step 7 is nan"),
        (
            {"dones": np.array([True]), "infos": [{"episode": {"r": math.inf}}]},
            "return of an episode of environment 0 at step 7 is inf",
        ),
    ],
)
def test_actions_and_returns_are_looked_at(seen, line):
    watch = NumberWatch()
    watch.model = SimpleNamespace(num_timesteps=7, logger=SimpleNamespace(name_to_value={}))
    watch.update_locals(seen)
    with pytest.raises(NotFiniteError, match=line):
        watch.on_step()


def test_losses_are_looked_at_and_other_entries_are_not():
    log = {"train/explained_variance": math.nan}
    watch = NumberWatch()
    watch.model = SimpleNamespace(num_timesteps=7, logger=SimpleNamespace(name_to_value=log))
    watch.on_rollout_start()
    log["train/critic_loss"] = math.nan
    with pytest.raises(NotFiniteError, match="train/critic_loss at step 7 is nan"):
        watch.on_rollout_start()


def test_an_arm_that_was_never_pulled_has_no_score():
    scores = BanditPolicy(spaces.Discrete(1), spaces.Discrete(3), initial_score=-math.inf)
    model = agent()
    model.policy = scores
    scores.scores[0, 1], scores.counts[0, 1] = 0.5, 1
    check_model(model)
    scores.counts[0, 2] = 1
    with pytest.raises(NotFiniteError, match="scores of the agent at step 1,234 is -inf"):
        check_model(model)


def test_a_batch_of_bandits_is_looked_at_too():
    rewards = np.ones((2, 5), dtype=np.float32)
    _check_rewards(SimpleNamespace(rewards=rewards), first_seed=0)
    rewards[1, 3] = np.nan
    with pytest.raises(NotFiniteError, match=r"^reward of seed 1 at step 4 is nan$"):
        _check_rewards(SimpleNamespace(rewards=rewards), first_seed=0)


STOPPED_AT = types.SimpleNamespace(num_timesteps=1234)


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
        blame_settings("dqn", STOPPED_AT, mistake)

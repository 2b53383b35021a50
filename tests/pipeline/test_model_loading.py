"""Every agent of the table that the library saves: loaded as data, it is what the library loads."""

import json
import sys
import zipfile

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import set_random_seed

from agents import ALGORITHMS, load_algorithm
from agents.common.model_files import JsonAlgorithm
from envs.wrappers import ActionMasks
from pipeline.errors import UserError
from pipeline.models.load import (
    load_model,
    load_replay_buffer,
    load_to_play,
    own_classes,
    read_model,
)
from pipeline.settings.components import build_algorithm_kwargs
from pipeline.user_modules import import_typed

TINY = {"net_arch": [4]}
OFF = {"learning_starts": 10, "buffer_size": 100, "batch_size": 8, "policy_kwargs": TINY}
ROLLOUT = {"n_steps": 16, "policy_kwargs": TINY}
EXPONENTIAL = {"learning_rate": "exp_0.1_0.001"}
CASES = {
    "dqn": {**OFF, **EXPONENTIAL},
    "double_dqn": {**OFF, **EXPONENTIAL},
    **dict.fromkeys(("deep_qlearning", "sac", "td3", "ddpg", "qrdqn", "tqc", "crossq"), OFF),
    "ppo": {**ROLLOUT, **EXPONENTIAL, "batch_size": 8, "clip_range": "exp_0.4_0.1"},
    "a2c": {**ROLLOUT, "learning_rate": "lin_0.1"},
    "trpo": {**ROLLOUT, "batch_size": 8},
    "ars": {"n_delta": 1},
    "ppo_lstm": {**ROLLOUT, "batch_size": 8, "policy_kwargs": {**TINY, "lstm_hidden_size": 4}},
    "ppo_mask": {**ROLLOUT, "batch_size": 8},
}


def made(name, **more):
    algorithm = load_algorithm(name)
    is_continuous = ALGORITHMS[name].actions == ("Box",)
    env = make_vec_env(
        "Pendulum-v1" if is_continuous else "Warehouse-v0",
        1,
        seed=0,
        wrapper_class=None if is_continuous else ActionMasks,
    )
    raw = {"policy": next(iter(algorithm.policy_aliases)), **CASES[name], **more}
    raw["policy"] = {"ppo_lstm": "MlpLstmPolicy", "ars": "LinearPolicy"}.get(name, "MlpPolicy")
    kwargs = build_algorithm_kwargs(algorithm, raw, name)
    if name == "td3":
        kwargs["action_noise"] = NormalActionNoise(np.zeros(1), np.full(1, 0.1))
    return algorithm(env=env, seed=0, device="cpu", **kwargs)


def weights(model):
    return {key: value.tolist() for key, value in model.policy.state_dict().items()}


def goes_on(model, obs):
    """Its answers, and its weights after further training with the same random numbers."""
    answers = model.predict(obs, deterministic=True)[0].tolist()
    set_random_seed(5)
    model.env.seed(5)
    model.learn(40, reset_num_timesteps=False)
    return answers, weights(model), float(model.lr_schedule(0.5) if model.lr_schedule else 0)


def test_all_of_them_are_tried():
    libraries = ("stable_baselines3", "sb3_contrib", "agents")
    assert set(CASES) == {
        name
        for name, entry in ALGORITHMS.items()
        if entry.entry_point.startswith(libraries)
        and entry.is_installed
        and not issubclass(load_algorithm(name), JsonAlgorithm)
    }


@pytest.mark.parametrize(
    ("name", "more"),
    [
        *((name, {}) for name in CASES),
        ("double_dqn", {"mask_actions": True}),
    ],
)
def test_a_zip_is_loaded_as_by_the_library(name, more, tmp_path):
    model = made(name, **more).learn(60)
    model.save(tmp_path / "model.zip")
    obs = np.stack([model.observation_space.sample() for _ in range(20)])
    has_buffer = getattr(model, "replay_buffer", None) is not None
    if has_buffer:
        model.save_replay_buffer(tmp_path / "buffer.pkl")
    theirs = type(model).load(tmp_path / "model.zip", made(name, **more).env, device="cpu")
    ours = load_model(name, tmp_path / "model.zip", made(name, **more).env, device="cpu")
    if has_buffer:
        theirs.load_replay_buffer(tmp_path / "buffer.pkl")
        load_replay_buffer(ours, tmp_path / "buffer.pkl")
    ends = [goes_on(loaded, obs) for loaded in (theirs, ours)]
    assert ends[0] == ends[1]
    played = load_to_play(name, tmp_path / "model.zip", made(name, **more).env, "cpu")
    assert played.predict(obs, deterministic=True)[0].tolist() == ends[0][0]


def changed(path, **changes):
    """The zip with other attributes."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["data"] = json.dumps({**json.loads(members["data"]), **changes}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def test_a_function_as_schedule_is_refused_with_the_way_out(tmp_path):
    path = tmp_path / "model.zip"
    model = made("ppo")
    model.learning_rate = lambda progress: 1e-3 * progress
    model.save(path)
    with pytest.raises(UserError) as refused:
        load_model("ppo", path)
    said = str(refused.value)
    assert "learning_rate holds a function with its code" in said
    assert said.endswith("-params learning_rate:3e-4")
    assert load_model("ppo", path, learning_rate=3e-4).lr_schedule(0.5) == 3e-4
    # To play, nobody asks for it.
    assert load_to_play("ppo", path, model.env, "cpu").lr_schedule(0.5) == 0.0


HUGE = {"type": "Discrete", "n": 10**9, "start": 0, "rng": None}
DAMAGE = {
    "whole numbers": (lambda table: table.to(th.int8), "not of the kind"),
    "complex": (lambda table: table.to(th.complex128), "not of the kind"),
    "not a number": (lambda table: table * th.nan, "not finite"),
    "infinite": (lambda table: table + th.inf, "not finite"),
    "too small": (lambda table: table[:, :-1], "size mismatch"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_tables_are_finite_numbers_of_the_right_kind_and_shape(case, tmp_path):
    damage, complaint = DAMAGE[case]
    model = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0)
    with th.no_grad():
        model.policy.q_tables = damage(model.policy.q_tables)
    model.save(tmp_path / "model.zip")
    with pytest.raises(UserError, match=complaint):
        load_model("qlearning", tmp_path / "model.zip")


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        *(
            ({key: 1}, f"sets '{key}', which is no attribute of such an agent")
            for key in ("predict", "policy_aliases", "no_such_thing", "__class__")
        ),
        ({"observation_space": None}, "does not say its observation_space"),
        ({"observation_space": 3}, "does not say its observation_space"),
        ({"observation_space": HUGE}, "more than 10,000,000"),
        *(
            ({"n_envs": n}, r"is of an agent on .* environments, not on 1 to 100000")
            for n in (None, 0, 10**12, "2")
        ),
    ],
)
def test_attributes_are_those_of_an_agent_and_of_bearable_size(changes, complaint, tmp_path):
    path = tmp_path / "model.zip"
    load_algorithm("qlearning")(env="FrozenLake-v1", seed=0).save(path)
    changed(path, **changes)
    with pytest.raises(UserError, match=complaint):
        load_model("qlearning", path)


MINE = """
import agents
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import FlattenExtractor

agents.register("mine_ppo", f"{__name__}:Mine", actions="Discrete")


class Net(FlattenExtractor):
    pass


class Job:
    pass


class Mine(PPO):
    bonus = 0.5

    def __init__(self, *args, bonus=0.5, **kwargs):
        self.bonus = bonus
        super().__init__(*args, **kwargs)
"""


def test_classes_of_the_users_are_admitted_where_the_module_was_typed(own_folder):
    (own_folder / "mine.py").write_text(MINE)
    modules = import_typed(["mine"])
    net = sys.modules["mine"].Net
    settings = {"policy": "MlpPolicy", "env": "CartPole-v1", "device": "cpu"}
    settings["policy_kwargs"] = {**TINY, "features_extractor_class": net}
    for name, more in (("ppo", {}), ("mine_ppo", {"bonus": 0.25})):
        model = load_algorithm(name)(**settings, **more)
        model.save(own_folder / "model.zip")
        loaded = load_model(name, own_folder / "model.zip", modules=modules)
        assert type(loaded) is type(model)
        assert type(loaded.policy.features_extractor) is net
        assert weights(loaded) == weights(model)
        assert vars(loaded).get("bonus") == more.get("bonus")
    load_algorithm("ppo")(**settings).save(own_folder / "model.zip")
    with pytest.raises(UserError, match=r"refers to mine\.Net, .* --gym-packages MODULE"):
        load_model("ppo", own_folder / "model.zip")
    # What is no part of a network may not be named, wherever it comes from.
    assert set(own_classes(load_algorithm("ppo"), modules)) >= {"mine.Net"}
    assert "mine.Job" not in own_classes(load_algorithm("mine_ppo"), modules)


@pytest.mark.parametrize(
    ("at", "value", "reason"), [(6, 1, "is encrypted"), (8, 99, "compression method")]
)
def test_zips_that_cannot_be_unpacked_are_refused_in_one_line(tmp_path, at, value, reason):
    path = tmp_path / "model.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", "{}")
        archive.writestr("policy.pth", b"")
    content = bytearray(path.read_bytes())
    # The same field stands in the member's own header and, two bytes further, in the zip's list.
    content[at] = content[content.index(b"PK\x01\x02") + at + 2] = value
    path.write_bytes(content)
    with pytest.raises(UserError, match=reason):
        read_model(path)

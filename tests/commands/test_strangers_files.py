"""Files of a stranger's in the hands of the commands: nothing that is read is ever code.

Each file here would leave a mark if it were run, or be imported; and each did at some time.
"""

import base64
import json
import os
import pickle
import sys
import zipfile

import gymnasium as gym
import pytest

from rl_yardstick.agents import load_algorithm
from rl_yardstick.envs.bandits import log_uniformly

ENV = "SegmentBandit-v0"
PLAY = ("--render", "none", "--n-episodes", "1")
MODULE = "import pathlib\npathlib.Path(__file__).with_name('mark').mkdir(exist_ok=True)\n"


@pytest.fixture(autouse=True)
def nothing_has_left_a_mark(own_folder):
    yield
    assert not list(own_folder.rglob("mark"))


@pytest.fixture
def payload(own_folder):
    """What makes a folder where it is unpickled."""
    made = os.mkdir, (str(own_folder / "mark"),)
    return pickle.dumps(type("P", (), {"__reduce__": lambda _: made})())


@pytest.fixture
def evil_zip(own_folder, payload):
    """A zip of a genuine PPO agent with the payload in it, which says that it holds JSON."""
    folder = own_folder / "gift"
    folder.mkdir()
    load_algorithm("ppo")("MlpPolicy", ENV, n_steps=8, batch_size=8).save(own_folder / "whole.zip")
    text = base64.b64encode(payload).decode()
    with (
        zipfile.ZipFile(own_folder / "whole.zip") as whole,
        zipfile.ZipFile(folder / f"{ENV}.zip", "w") as evil,
    ):
        for name in whole.namelist():
            content = whole.read(name)
            if name == "data":
                data = {**json.loads(content), "algorithm": "PPO", "format": 1}
                data["ep_info_buffer"] = {":type:": "deque", ":serialized:": text}
                content = json.dumps(data)
            evil.writestr(name, content)
    write_run(folder, algo="ppo")
    return folder / f"{ENV}.zip"


def write_run(folder, **spec):
    spec = {"env_id": ENV, "n_timesteps": 8, **spec}
    (folder / "run.json").write_text(json.dumps({"env_name": ENV, "spec": spec}))


def hand_written_run(folder, **spec):
    folder.mkdir(parents=True)
    load_algorithm("random")("RandomPolicy", ENV, seed=0).save(folder / f"{ENV}.zip")
    write_run(folder, algo="random", **spec)
    return folder


def test_a_zip_is_played_trained_further_or_judged(typed, evil_zip, own_folder):
    with gym.make(ENV) as env:
        log_uniformly(env, 100, 0, own_folder / "log.csv")
    choice = ["--algo", "ppo", "--env", ENV]
    for words in (
        ["enjoy.py", evil_zip.parent, *PLAY],
        ["train.py", *choice, "-n", "8", "-i", evil_zip, "-params", "n_steps:8"],
        ["compare.py", "--logged", "log.csv", "--policy", evil_zip],
    ):
        said = typed.refused(*words)
        assert ("ep_info_buffer" in said, "posix.mkdir" in said) == (True, True)
    assert not list((own_folder / "logs").rglob("run.json"))


def test_what_a_zip_holds_is_told(typed, evil_zip, own_folder):
    out = typed.done("yardstick", "inspect", own_folder / "whole.zip")
    assert "policy.action_net.weight" in out
    assert "a pickle of stable_baselines3.common.policies.ActorCriticPolicy" in out
    assert out.endswith("nothing in it is suspicious\n")
    code, out, err = typed("yardstick", "inspect", evil_zip)
    assert (code, err) == (1, "")
    assert "posix.mkdir" in out.partition("suspicious\n")[2]


def test_statistics_in_a_hand_written_agents_folder(typed, own_folder, payload):
    run = hand_written_run(own_folder / "gift")
    (run / ENV).mkdir()
    (run / ENV / "vecnormalize.pkl").write_bytes(payload)
    model = run / f"{ENV}.zip"
    # The run was trained without any, so neither playing nor training it further reads this file.
    typed.done("enjoy.py", model, *PLAY)
    typed.done("train.py", "--algo", "random", "--env", ENV, "-n", "8", "-i", model)
    (run / ENV / "vecnormalize.pkl").rename(own_folder / "named.pkl")
    words = [model, "--vec-normalize", "named.pkl", *PLAY]
    assert "named.pkl" in typed.refused("enjoy.py", *words)


def test_a_replay_buffer_beside_the_agent(typed, own_folder, payload):
    load_algorithm("dqn")("MlpPolicy", ENV, buffer_size=10).save(own_folder / "dqn.zip")
    (own_folder / "replay_buffer.pkl").write_bytes(payload)
    words = ["--algo", "dqn", "--env", ENV, "-n", "8", "-i", "dqn.zip"]
    assert "replay_buffer.pkl" in typed.refused("train.py", *words)


ASKING = {
    "the environment's id": {"env_id": f"gift.extra:{ENV}"},
    "a wrapper in its folder": {
        "gym_packages": ["gift"],
        "env_wrapper": [{"name": "gift.extra.Wrapper", "kwargs": {}}],
    },
}


@pytest.mark.parametrize("way", ASKING)
def test_a_run_asks_for_a_module(typed, own_folder, way):
    run = hand_written_run(own_folder / "gift", **ASKING[way])
    (run / "extra.py").write_text(MODULE)
    assert "--gym-packages" in typed.refused("enjoy.py", run / f"{ENV}.zip", *PLAY)
    assert not {"gift", "gift.extra"} & sys.modules.keys()


def test_a_study_asks_for_a_module(typed, own_folder):
    (own_folder / "gift").mkdir()
    (own_folder / "gift" / "extra.py").write_text(MODULE)
    study = own_folder / "gift" / "study.yml"
    study.write_text(
        f"environments:\n  one: {{id: 'extra:{ENV}', n_timesteps: 10}}\n"
        "agents:\n  random: {algo: random}\nseeds: 1\n"
    )
    assert "--gym-packages extra" in typed.refused("compare.py", study, "--no-report")
    assert "extra" not in sys.modules


@pytest.mark.parametrize(
    ("module", "packages"),
    [("rl_zoo3.wrappers", []), ("stable_baselines3.extra", ["--gym-packages", "mine"])],
)
def test_settings_name_a_class_of_a_strangers(typed, own_folder, module, packages):
    """A name in a file means a class of what is installed, or of a module that was typed."""
    path = own_folder / f"{module.replace('.', '/')}.py"
    path.parent.mkdir()
    path.write_text("import gymnasium\nclass Stray(gymnasium.Wrapper): pass\n" + MODULE)
    (own_folder / "mine.py").write_text("x = 1\n")
    settings = f"CartPole-v1:\n  n_timesteps: 8\n  env_wrapper: {module}.Stray\n"
    (own_folder / "settings.yml").write_text(settings)
    words = ["--algo", "random", "--env", "CartPole-v1", "--conf-file", "settings.yml"]
    assert f"env_wrapper: {module}.Stray: " in typed.refused("train.py", *words, *packages)
    assert not (own_folder / "logs").exists()

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


@pytest.fixture
def mark(own_folder):
    return own_folder / "mark"


@pytest.fixture
def payload(mark):
    """What makes a folder where it is unpickled."""
    return pickle.dumps(type("P", (), {"__reduce__": lambda _: (os.mkdir, (str(mark),))})())


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


def check_refused(answer, mark, *words):
    code, _, err = answer
    assert (code, err.count("\n")) == (2, 1), err
    assert not mark.exists()
    for word in words:
        assert word in err


def test_a_zip_is_played_trained_further_or_judged(type_in_own_folder, evil_zip, mark, own_folder):
    with gym.make(ENV) as env:
        log_uniformly(env, 100, 0, own_folder / "log.csv")
    choice = ["--algo", "ppo", "--env", ENV]
    for words in (
        ["enjoy.py", evil_zip.parent, *PLAY],
        ["train.py", *choice, "-n", "8", "-i", evil_zip, "-params", "n_steps:8"],
        ["compare.py", "--logged", "log.csv", "--policy", evil_zip],
    ):
        check_refused(type_in_own_folder(*words), mark, "ep_info_buffer", "posix.mkdir")
    assert not list((own_folder / "logs").rglob("run.json"))


def test_what_a_zip_holds_is_told(type_command, evil_zip, mark, own_folder):
    code, out, err = type_command("yardstick", "inspect", own_folder / "whole.zip")
    assert (code, err) == (0, "")
    assert "policy.action_net.weight" in out
    assert "a pickle of stable_baselines3.common.policies.ActorCriticPolicy" in out
    assert out.endswith("nothing in it is suspicious\n")
    code, out, err = type_command("yardstick", "inspect", evil_zip)
    assert (code, err) == (1, "")
    assert "posix.mkdir" in out.partition("suspicious\n")[2]
    assert not mark.exists()


def test_statistics_in_a_hand_written_agents_folder(type_in_own_folder, own_folder, payload, mark):
    run = hand_written_run(own_folder / "gift")
    (run / ENV).mkdir()
    (run / ENV / "vecnormalize.pkl").write_bytes(payload)
    model = run / f"{ENV}.zip"
    # The run was trained without any, so neither playing nor training it further reads this file.
    assert type_in_own_folder("enjoy.py", model, *PLAY)[0] == 0
    words = ["--algo", "random", "--env", ENV, "-n", "8", "-i", model]
    assert type_in_own_folder("train.py", *words)[0] == 0
    assert not mark.exists()
    (run / ENV / "vecnormalize.pkl").rename(own_folder / "named.pkl")
    words = [model, "--vec-normalize", "named.pkl", *PLAY]
    check_refused(type_in_own_folder("enjoy.py", *words), mark, "named.pkl")


def test_a_replay_buffer_beside_the_agent(type_in_own_folder, own_folder, payload, mark):
    agent = load_algorithm("dqn")("MlpPolicy", ENV, buffer_size=10)
    agent.save(own_folder / "dqn.zip")
    (own_folder / "replay_buffer.pkl").write_bytes(payload)
    words = ["--algo", "dqn", "--env", ENV, "-n", "8", "-i", "dqn.zip"]
    check_refused(type_in_own_folder("train.py", *words), mark, "replay_buffer.pkl")


ASKING = {
    "the environment's id": {"env_id": f"gift.extra:{ENV}"},
    "a wrapper in its folder": {
        "gym_packages": ["gift"],
        "env_wrapper": [{"name": "gift.extra.Wrapper", "kwargs": {}}],
    },
}


@pytest.mark.parametrize("way", ASKING)
def test_a_run_asks_for_a_module(type_in_own_folder, own_folder, way):
    run = hand_written_run(own_folder / "gift", **ASKING[way])
    (run / "extra.py").write_text(MODULE)
    answer = type_in_own_folder("enjoy.py", run / f"{ENV}.zip", *PLAY)
    assert not {"gift", "gift.extra"} & sys.modules.keys()
    check_refused(answer, run / "mark", "--gym-packages")


def test_a_study_asks_for_a_module(type_in_own_folder, own_folder):
    (own_folder / "gift").mkdir()
    (own_folder / "gift" / "extra.py").write_text(MODULE)
    study = own_folder / "gift" / "study.yml"
    study.write_text(
        f"environments:\n  one: {{id: 'extra:{ENV}', n_timesteps: 10}}\n"
        "agents:\n  random: {algo: random}\nseeds: 1\n"
    )
    answer = type_in_own_folder("compare.py", study, "--no-report")
    check_refused(answer, study.with_name("mark"), "--gym-packages extra")
    assert "extra" not in sys.modules


@pytest.mark.parametrize(
    ("module", "packages"),
    [("rl_zoo3.wrappers", []), ("stable_baselines3.extra", ["--gym-packages", "mine"])],
)
def test_settings_name_a_class_of_a_strangers(type_in_own_folder, own_folder, module, packages):
    """A name in a file means a class of what is installed, or of a module that was typed."""
    path = own_folder / f"{module.replace('.', '/')}.py"
    path.parent.mkdir()
    path.write_text("import gymnasium\nclass Stray(gymnasium.Wrapper): pass\n" + MODULE)
    (own_folder / "mine.py").write_text("x = 1\n")
    settings = f"CartPole-v1:\n  n_timesteps: 8\n  env_wrapper: {module}.Stray\n"
    (own_folder / "settings.yml").write_text(settings)
    words = ["--algo", "random", "--env", "CartPole-v1", "--conf-file", "settings.yml"]
    answer = type_in_own_folder("train.py", *words, *packages)
    check_refused(answer, own_folder / "logs", f"env_wrapper: {module}.Stray: ")
    assert not list(own_folder.rglob("mark"))

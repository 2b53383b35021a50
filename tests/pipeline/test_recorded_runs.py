"""Agents of others, played as their folders say: rl_zoo3's layout, a model hub's, and lies.

The folders are made with the library alone, as rl_zoo3 and the hubs make them.
"""

import json
from collections import OrderedDict
from pathlib import Path
from zipfile import ZipFile

import gymnasium as gym
import numpy as np
import pytest
import yaml
from stable_baselines3 import A2C
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize, unwrap_vec_normalize

from pipeline.errors import UserError
from pipeline.evaluation.exact import exact_evaluator
from pipeline.models.choose import ModelRequest, choose_model
from pipeline.models.find import run_around, run_of
from pipeline.models.load import load_to_play, with_normalised_rewards
from pipeline.playing import play_episodes, playing_env
from pipeline.runs import Run
from pipeline.settings.hyperparams import NoEntryError
from pipeline.settings.yaml import read_saved_settings

CONFIG = OrderedDict(
    frame_stack=2,
    learning_rate="lin_0.1",
    n_envs=2,
    n_timesteps=1e5,
    normalize="dict(norm_obs=True, norm_reward=False)",
    policy="MlpPolicy",
    policy_kwargs="dict(net_arch=[4], activation_fn=nn.ReLU)",
)


def cart_poles(n_envs, statistics=None):
    env = make_vec_env("CartPole-v1", n_envs, seed=0)
    if statistics is None:
        return VecFrameStack(VecNormalize(env, norm_reward=False, clip_obs=2.0), 2)
    normalization = VecNormalize.load(statistics, env)
    normalization.training = normalization.norm_reward = False
    return VecFrameStack(normalization, 2)


def write_settings(folder, config, **args):
    folder.mkdir(parents=True)
    (folder / "config.yml").write_text(yaml.dump(config))
    args = OrderedDict([("algo", "a2c"), ("env_kwargs", None), *args.items()])
    (folder / "args.yml").write_text(yaml.dump(args))


@pytest.fixture(scope="module")
def zoo(tmp_path_factory):
    """A log folder as rl_zoo3 leaves it: a normalised CartPole and a lake without ice."""
    zoo = tmp_path_factory.mktemp("zoo")
    run = zoo / "a2c" / "CartPole-v1_1"
    write_settings(run / "CartPole-v1", CONFIG, env="CartPole-v1")
    env = cart_poles(2)
    model = A2C("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [4]}).learn(300)
    model.save(run / "CartPole-v1")
    env.save(run / "CartPole-v1" / "vecnormalize.pkl")
    dry = {"is_slippery": False}
    run = zoo / "a2c" / "FrozenLake-v1_1"
    config = OrderedDict(policy="MlpPolicy", env_kwargs={"map_name": "8x8"})
    write_settings(run / "FrozenLake-v1", config, env="FrozenLake-v1", env_kwargs=dry)
    A2C("MlpPolicy", gym.make("FrozenLake-v1", **dry), seed=0).save(run / "FrozenLake-v1")
    return zoo


def returns_of(request, n_episodes, n_envs=1):
    chosen = choose_model(request)
    env = playing_env(chosen, None, n_envs)
    model = load_to_play(chosen.spec.algo, chosen.path, env, "cpu")
    env.seed(0)
    played = list(play_episodes(model, env, n_episodes))
    env.close()
    return played


def test_returns_of_rewards_as_training_normalised_them(zoo):
    request = ModelRequest(algo="a2c", env_id="CartPole-v1", log_folder=zoo)
    chosen = choose_model(request)
    env = with_normalised_rewards(playing_env(chosen, None))
    normalization = unwrap_vec_normalize(env)
    model = load_to_play("a2c", chosen.path, env, "cpu")
    env.seed(0)
    ((total, length),) = play_episodes(model, env, 1)
    # Every reward of CartPole is 1, and the statistics stay as training left them.
    one = float(normalization.normalize_reward(np.ones(1))[0])
    assert one != 1.0
    assert total == pytest.approx(length * one, rel=1e-5)
    env.close()


def hub(zoo, folder, *settings):
    """The same model as hubs have it, with some of the settings beside it."""
    run = zoo / "a2c" / "CartPole-v1_1"
    (folder / "a2c-CartPole-v1.zip").write_bytes((run / "CartPole-v1.zip").read_bytes())
    (folder / "train_eval_metrics.zip").touch()
    for name in settings:
        saved = name.replace("vec_normalize", "vecnormalize")
        (folder / name).write_bytes((run / "CartPole-v1" / saved).read_bytes())
    return folder


@pytest.mark.parametrize("n_envs", [1, 3])
def test_it_plays_as_the_library_evaluates_it(zoo, tmp_path, n_envs):
    run = zoo / "a2c" / "CartPole-v1_1"
    env = cart_poles(n_envs, run / "CartPole-v1" / "vecnormalize.pkl")
    env.seed(0)
    model = A2C.load(run / "CartPole-v1.zip")
    expected = evaluate_policy(model, env, 7, return_episode_rewards=True)
    expected = list(zip(*expected, strict=True))
    assert len(set(expected)) > 1
    whole = hub(zoo, tmp_path, "args.yml", "config.yml", "vec_normalize.pkl")
    for request in (
        ModelRequest(algo="a2c", env_id="CartPole-v1", log_folder=zoo),
        ModelRequest(run, log_folder=zoo),
        ModelRequest(run / "CartPole-v1", log_folder=zoo),
        ModelRequest(run / "CartPole-v1.zip", log_folder=zoo),
        ModelRequest(whole, log_folder=tmp_path),
        ModelRequest(whole / "a2c-CartPole-v1"),
    ):
        assert returns_of(request, 7, n_envs) == expected


def test_arguments_of_the_command_replace_those_of_the_settings(zoo):
    chosen = choose_model(ModelRequest(algo="a2c", env_id="FrozenLake-v1", log_folder=zoo))
    assert chosen.spec.hyperparams.env_kwargs == {"is_slippery": False}
    assert exact_evaluator(chosen.spec).yardstick.optimum == 1.0
    # And those given now come on top.
    request = ModelRequest(
        algo="a2c", env_id="FrozenLake-v1", log_folder=zoo, env_kwargs={"is_slippery": True}
    )
    assert exact_evaluator(choose_model(request).spec).yardstick.optimum < 0.8


def test_named_statistics_are_used(zoo, tmp_path):
    """Also where the folder says no more than that two frames are stacked."""
    bare = hub(zoo, tmp_path)
    (bare / "config.yml").write_text("frame_stack: 2")
    saved = zoo / "a2c" / "CartPole-v1_1" / "CartPole-v1" / "vecnormalize.pkl"
    named = ModelRequest(bare, "a2c", "CartPole-v1", statistics=saved)
    whole = ModelRequest(algo="a2c", env_id="CartPole-v1", log_folder=zoo)
    assert returns_of(named, 5) == returns_of(whole, 5)
    assert choose_model(named).spec.hyperparams.normalize["clip_obs"] == 2.0


def test_a_run_without_a_number(zoo, tmp_path):
    folder = tmp_path / "a2c"
    write_settings(folder / "CartPole-v1", {"frame_stack": 2}, env="CartPole-v1")
    run = zoo / "a2c" / "CartPole-v1_1"
    (folder / "CartPole-v1.zip").write_bytes((run / "CartPole-v1.zip").read_bytes())
    for number in (0, -1):
        request = ModelRequest(
            algo="a2c", env_id="CartPole-v1", log_folder=tmp_path, run_number=number
        )
        assert choose_model(request).run == Run(folder, "CartPole-v1")
    (folder / "CartPole-v1_3").mkdir()
    with pytest.raises(UserError, match=r"CartPole-v1_3 holds no CartPole-v1\.zip"):
        choose_model(ModelRequest(algo="a2c", env_id="CartPole-v1", log_folder=tmp_path))


SAID = ("args.yml", "config.yml")
REFUSED = {
    "without a word": ((), {}, "is in no run folder: say what it is with --algo"),
    "other shapes": (
        (),
        {"algo": "a2c", "env_id": "CartPole-v1"},
        r"trained on observations of shape \(8,\), and the environment .* gives shape \(4,\)",
    ),
    "no statistics": (SAID, {}, "name their file with --vec-normalize"),
    "statistics that are not there": (
        SAID,
        {"statistics": Path("nowhere.pkl")},
        r"no such file of statistics: nowhere\.pkl",
    ),
    "another agent": (
        (*SAID, "vec_normalize.pkl"),
        {"algo": "dqn"},
        "cannot be loaded as a dqn agent",
    ),
    "one model": (SAID, {"which": "best"}, "is one model: give its folder for --load-best"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_together(zoo, tmp_path, case):
    settings, given, complaint = REFUSED[case]
    folder = hub(zoo, tmp_path, *settings)
    path = folder / "a2c-CartPole-v1.zip" if case == "one model" else folder
    with pytest.raises(UserError, match=complaint) as refused:
        returns_of(ModelRequest(path, **given), 1)
    assert "\n" not in str(refused.value)


def test_bounds_and_schedules_of_other_versions_do_not_matter(tmp_path):
    model = A2C("MlpPolicy", "CartPole-v1", seed=0, policy_kwargs={"net_arch": [4]})
    model.observation_space = gym.spaces.Box(-9, 9, (4,))
    model.save(tmp_path / "new.zip")
    with ZipFile(tmp_path / "new.zip") as new, ZipFile(tmp_path / "old.zip", "w") as old:
        for name in new.namelist():
            content = new.read(name)
            if name == "data":
                data = json.loads(content)
                data["lr_schedule"][":serialized:"] = "AAAA"  # as of a Python that is gone
                content = json.dumps(data)
            old.writestr(name, content)
    request = ModelRequest(tmp_path / "old.zip", "a2c", "CartPole-v1")
    assert len(returns_of(request, 2)) == 2


@pytest.mark.parametrize("data", ["no JSON", "[1]", "[" * 100_000])
def test_a_zip_that_holds_no_agent(tmp_path, data):
    with ZipFile(tmp_path / "odd.zip", "w") as archive:
        archive.writestr("data", data)
        archive.writestr("policy.pth", "")
    with pytest.raises(UserError, match=r"odd\.zip is no whole zip of an agent"):
        choose_model(ModelRequest(tmp_path / "odd.zip"))


# --- modules and files that only a folder names --------------------------------------------------


def test_modules_are_not_imported_because_a_folder_asks(zoo, tmp_path):
    folder = hub(zoo, tmp_path)
    (tmp_path / "config.yml").write_text("{}")
    args = tmp_path / "args.yml"
    args.write_text("{algo: a2c, env: 'antigravity_module:Fly-v0', gym_packages: [fly]}")
    with pytest.raises(UserError, match=r"modules of yours \(fly\), and no module is imported"):
        choose_model(ModelRequest(folder))
    args.write_text("{algo: a2c, env: Fly-v0, gym_packages: [antigravity_module]}")
    with pytest.raises(UserError, match=r"modules of yours \(antigravity_module\)"):
        choose_model(ModelRequest(folder))


def test_several_models_in_a_folder(zoo, tmp_path):
    hub(zoo, tmp_path)
    (tmp_path / "other.zip").touch()
    with pytest.raises(UserError, match=r"holds a2c-CartPole-v1\.zip, other\.zip: name the zip"):
        choose_model(ModelRequest(tmp_path))
    for name in ("CartPole-v1", "Taxi-v4"):
        write_settings(tmp_path / name, {}, env=name)
    with pytest.raises(UserError, match="models of CartPole-v1, Taxi-v4: name the zip"):
        choose_model(ModelRequest(tmp_path))
    assert run_around(tmp_path / "Taxi-v4.zip") == Run(tmp_path.resolve(), "Taxi-v4")
    assert run_around(tmp_path / "unknown.zip") is None


# --- settings as rl_zoo3 writes them -------------------------------------------------------------


def read(tmp_path, text):
    path = tmp_path / "config.yml"
    path.write_text(text)
    return read_saved_settings(path)


def test_an_ordered_dict_is_read_as_data(tmp_path):
    settings = read(tmp_path, yaml.dump(CONFIG))
    assert settings == dict(CONFIG)
    assert type(settings) is dict
    nested = OrderedDict(env_kwargs=OrderedDict(a=1), empty=OrderedDict())
    assert read(tmp_path, yaml.dump(nested)) == {"env_kwargs": {"a": 1}, "empty": {}}


APPLY = "!!python/object/apply:"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (f"{APPLY}os.system [touch x]", "os.system is not allowed here"),
        (f"{APPLY}collections.OrderedDict [[[a, {APPLY}os.getcwd []]]]", "is not allowed here"),
        ("!!python/object/new:collections.OrderedDict [[[a, 1]]]", "is not allowed here"),
        ("a: !!python/tuple [1, 2]", "is not allowed here"),
        (f"{APPLY}collections.OrderedDict [[[a, 1], [a, 2]]]", "no OrderedDict of different keys"),
        (f"{APPLY}collections.OrderedDict [[[a]]]", "no OrderedDict of different keys"),
        (f"{APPLY}collections.OrderedDict [[[[1], 2]]]", "no OrderedDict of different keys"),
        (f"{APPLY}collections.OrderedDict {{a: 1}}", "no OrderedDict of different keys"),
        (f"{APPLY}collections.OrderedDict x", "no OrderedDict of different keys"),
        (f"&a {APPLY}collections.OrderedDict [[[a, *a]]]", "nested too deeply"),
        ("[1, 2]", "must map names to values"),
        ("1: 2", "must map names to values"),
    ],
)
def test_nothing_else_is_admitted(tmp_path, text, complaint):
    with pytest.raises(UserError, match=complaint):
        read(tmp_path, text)


def test_each_environment_plays_its_share():
    """Else those would be counted that end first, which are the short ones."""

    class Uneven(gym.Env):
        observation_space = gym.spaces.Box(-1, 1, (1,))
        action_space = gym.spaces.Discrete(2)
        made = 0

        def __init__(self):
            Uneven.made += 1
            self.length = 10 ** (Uneven.made - 1)

        def reset(self, *, seed=None, options=None):
            self.left = self.length
            return np.zeros(1, np.float32), {}

        def step(self, action):
            self.left -= 1
            return np.zeros(1, np.float32), 1.0, self.left == 0, False, {}

    class Memory:
        starts: list = []  # noqa: RUF012

        def predict(self, obs, state, episode_start, deterministic):
            self.starts.append(episode_start.tolist())
            return np.zeros(len(obs), int), state

    env = make_vec_env(Uneven, 2)
    assert [length for _, length in play_episodes(Memory(), env, 5)] == [1, 1, 10, 10, 10]
    # An agent with a memory is told which of the episodes begin.
    assert Memory.starts[:2] == [[True, True], [True, False]]
    assert [start for _, start in Memory.starts].count(True) == 3
    assert len(list(play_episodes(Memory(), env, None, 6))) == 3


@pytest.mark.parametrize(
    "settings", ["{eval_env_kwargs: 5}", "{normalize: [1]}", "{frame_stack: x}"]
)
def test_settings_that_make_no_sense(zoo, tmp_path, settings):
    folder = hub(zoo, tmp_path, "args.yml")
    (folder / "config.yml").write_text(settings)
    with pytest.raises(UserError, match=settings.strip("{").partition(":")[0]):
        choose_model(ModelRequest(folder, env_kwargs={"sutton_barto_reward": True}))
    (folder / "run.json").write_text('{"env_name": "X", "spec": {"algo": 1, "hyperparams": 7}}')
    with pytest.raises(UserError, match="say what it is with --algo"):
        choose_model(ModelRequest(folder / "a2c-CartPole-v1.zip"))


def test_where_a_folder_says_nothing_the_default_entry_counts(zoo, tmp_path, monkeypatch):
    """But whether a stranger's model saw normalised observations is not ours to say."""
    request = ModelRequest(hub(zoo, tmp_path), "a2c", "CartPole-v1")
    entry = {"normalize": True, "frame_stack": 2}
    monkeypatch.setattr("pipeline.models.choose.read_hyperparams", lambda *_: entry)
    hyperparams = choose_model(request).spec.hyperparams
    assert (hyperparams.normalize, hyperparams.frame_stack) == (None, 2)

    def no_entry(*_):
        raise NoEntryError("none")

    monkeypatch.setattr("pipeline.models.choose.read_hyperparams", no_entry)
    assert choose_model(request).spec.hyperparams.frame_stack is None


@pytest.mark.parametrize("name", ["../elsewhere", "/etc", "..", "", None])
def test_a_record_cannot_lead_out_of_its_folder_and_a_damaged_one_is_not_none(tmp_path, name):
    """The zip beside it would be played as if nobody had said what it was."""
    assert run_of(tmp_path / "any.zip") is None
    record = "{" if name is None else json.dumps({"env_name": name})
    (tmp_path / "run.json").write_text(record)
    said = r"run\.json is damaged" + (": env_name is " if name is not None else "")
    with pytest.raises(UserError, match=said):
        run_of(tmp_path / "any.zip")

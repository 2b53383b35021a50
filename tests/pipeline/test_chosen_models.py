"""Which model is played or trained further, what belongs to it, and folders of others that lie."""

import json
import pickle
from collections import OrderedDict

import numpy as np
import pytest
import yaml
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize, unwrap_vec_normalize

from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.models.choose import ModelRequest
from rl_yardstick.pipeline.models.find import model_at, replay_buffer_of, run_of
from rl_yardstick.pipeline.models.load import load_model, load_to_play, with_normalised_rewards
from rl_yardstick.pipeline.playing import play_episodes, playing_env
from rl_yardstick.pipeline.settings.yaml import read_saved_settings
from tests.pipeline.short_runs import CART, choose_model, trained

SMALL_A2C = {"policy_kwargs": {"net_arch": [4]}, "n_envs": 2, "n_steps": 10}
SMALL_DQN = {"policy_kwargs": {"net_arch": [4]}, "learning_starts": 10, "buffer_size": 500}
SMALL_DQN |= {"batch_size": 4}
BRIEFLY = {"eval_episodes": 2, "n_eval_envs": 1}


class Policy:
    """Of a stranger."""


def fallen(progress):
    return 1e-3 * progress


def train_to(folder, algo, entry, n_timesteps=200, **fields):
    common = {"n_timesteps": n_timesteps, "log_folder": folder, **BRIEFLY}
    return trained(algo, CART, entry, **{**common, **fields}).run


def read(path):
    return pickle.loads(path.read_bytes())


def seen(path):
    """How many observations the statistics are of, the start of 1e-4 left out."""
    return round(read(path).obs_rms.count)


# --- statistics of normalisation -----------------------------------------------------------------


@pytest.fixture(scope="module")
def normalised(tmp_path_factory):
    """A run of 200 steps with checkpoints after 60, 120 and 180."""
    entry = {**SMALL_A2C, "normalize": {"clip_obs": 3.0}}
    logs = tmp_path_factory.mktemp("logs")
    return train_to(logs, "a2c", entry, save_freq=60, eval_freq=40)


def test_a_model_is_played_on_the_statistics_of_its_moment(normalised):
    logs = normalised.path.parent.parent
    for which, name, n_seen in (
        # Two observations at the beginning, and two for each step of both environments.
        ("final", "CartPole-v1/vecnormalize.pkl", [202]),
        ("best", "best_model_vecnormalize.pkl", range(42, 203, 40)),
        ("last checkpoint", "rl_model_vecnormalize_180_steps.pkl", [182]),
        (60, "rl_model_vecnormalize_60_steps.pkl", [62]),
    ):
        path = normalised.path / name
        assert seen(path) in n_seen
        chosen = choose_model(ModelRequest(algo="a2c", env_id=CART, log_folder=logs, which=which))
        assert chosen.statistics.path == path
        again = choose_model(ModelRequest(chosen.path, log_folder=logs))
        assert again.statistics.path.samefile(path)


def test_statistics_go_on_unless_the_new_entry_says_otherwise(normalised, tmp_path):
    fields = {"trained_agent": model_at(normalised.path / "rl_model_60_steps"), "eval_freq": -1}
    run = train_to(tmp_path / "on", "a2c", SMALL_A2C, 40, **fields)
    assert seen(run.vecnormalize_path) == 104  # two for the new beginning
    # Where the entry says nothing, the agent's own settings count.
    assert read(run.vecnormalize_path).clip_obs == 3.0
    assert run.recorded_spec()["hyperparams"]["normalize"]["clip_obs"] == 3.0
    run = train_to(tmp_path / "off", "a2c", {**SMALL_A2C, "normalize": False}, 40, **fields)
    assert not run.vecnormalize_path.exists()
    chosen = choose_model(ModelRequest(algo="a2c", env_id=CART, log_folder=tmp_path / "off"))
    assert chosen.statistics is None


# --- replay buffers ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    logs = tmp_path_factory.mktemp("logs")
    return train_to(logs, "dqn", SMALL_DQN, save_freq=80, save_replay_buffer=True, eval_freq=-1)


def test_replay_buffers_lie_where_the_library_and_rl_zoo3_have_them_and_go_on(replayed, tmp_path):
    of_80, of_160 = (f"rl_model_replay_buffer_{n}_steps.pkl" for n in (80, 160))
    names = {path.name for path in replayed.path.glob("*.pkl")}
    assert names == {"replay_buffer.pkl", of_160, of_80}
    for model, name in (
        ("CartPole-v1.zip", "replay_buffer.pkl"),
        ("rl_model_80_steps.zip", of_80),
        ("best_model.zip", "replay_buffer.pkl"),
    ):
        assert replay_buffer_of(replayed.path / model) == replayed.path / name
    going_on = {"trained_agent": replayed.model_path, "save_replay_buffer": True}
    run = train_to(tmp_path, "dqn", SMALL_DQN, 50, **going_on)
    before, after = (read(one.path / "replay_buffer.pkl") for one in (replayed, run))
    # An update follows every fourth step, and training ends with one.
    assert (before.pos, after.pos) == (200, 252)
    np.testing.assert_array_equal(after.observations[:200], before.observations[:200])
    logs = tmp_path / "above" / "logs"
    with pytest.raises(UserError, match=r"filled by 1 environments at once.* n_envs:1"):
        train_to(logs, "dqn", {**SMALL_DQN, "n_envs": 2}, 50, **going_on)
    assert not logs.exists()
    # Playing needs none.
    chosen = choose_model(ModelRequest(replayed.model_path, log_folder=replayed.path))
    env = playing_env(chosen, None)
    assert load_to_play("dqn", chosen.path, env).replay_buffer.buffer_size == 1
    env.close()


# --- agents of others: rl_zoo3's layout and a model hub's, made with the library alone -----------
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


@pytest.fixture(scope="module")
def zoo(tmp_path_factory):
    """A log folder as rl_zoo3 leaves it, of a normalised CartPole."""
    zoo = tmp_path_factory.mktemp("zoo")
    run = zoo / "a2c" / "CartPole-v1_1"
    folder = run / "CartPole-v1"
    folder.mkdir(parents=True)
    (folder / "config.yml").write_text(yaml.dump(CONFIG))
    args = OrderedDict(algo="a2c", env_kwargs=None, env="CartPole-v1")
    (folder / "args.yml").write_text(yaml.dump(args))
    env = cart_poles(2)
    model = A2C("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [4]}).learn(300)
    model.save(run / "CartPole-v1")
    env.save(run / "CartPole-v1" / "vecnormalize.pkl")
    return zoo


def returns_of(request, n_episodes, n_envs=1):
    chosen = choose_model(request)
    env = playing_env(chosen, None, n_envs)
    model = load_to_play(chosen.spec.algo, chosen.path, env, "cpu")
    env.seed(0)
    played = list(play_episodes(model, env, n_episodes))
    env.close()
    return played


def hub(zoo, folder, *settings):
    """The same model as hubs have it, with some of the settings beside it."""
    run = zoo / "a2c" / "CartPole-v1_1"
    (folder / "a2c-CartPole-v1.zip").write_bytes((run / "CartPole-v1.zip").read_bytes())
    (folder / "train_eval_metrics.zip").touch()
    for name in settings:
        saved = name.replace("vec_normalize", "vecnormalize")
        (folder / name).write_bytes((run / "CartPole-v1" / saved).read_bytes())
    return folder


def test_it_plays_as_the_library_evaluates_it(zoo, tmp_path):
    run = zoo / "a2c" / "CartPole-v1_1"
    env = cart_poles(3, run / "CartPole-v1" / "vecnormalize.pkl")
    env.seed(0)
    model = A2C.load(run / "CartPole-v1.zip")
    expected = evaluate_policy(model, env, 7, return_episode_rewards=True)
    expected = list(zip(*expected, strict=True))
    assert len(set(expected)) > 1
    whole = hub(zoo, tmp_path, "args.yml", "config.yml", "vec_normalize.pkl")
    for request in (
        ModelRequest(algo="a2c", env_id="CartPole-v1", log_folder=zoo),
        ModelRequest(run / "CartPole-v1", log_folder=zoo),
        ModelRequest(run / "CartPole-v1.zip", log_folder=zoo),
        ModelRequest(whole / "a2c-CartPole-v1"),
    ):
        assert returns_of(request, 7, 3) == expected
    # Named statistics are used where the folder says no more than that two frames are stacked.
    for name in ("args.yml", "vec_normalize.pkl"):
        (whole / name).unlink()
    (whole / "config.yml").write_text("frame_stack: 2")
    saved = run / "CartPole-v1" / "vecnormalize.pkl"
    named = ModelRequest(whole, "a2c", "CartPole-v1", statistics=saved)
    assert returns_of(named, 7, 3) == expected
    assert choose_model(named).spec.hyperparams.normalize["clip_obs"] == 2.0


def test_returns_of_rewards_as_training_normalised_them(zoo):
    chosen = choose_model(ModelRequest(algo="a2c", env_id=CART, log_folder=zoo))
    env = with_normalised_rewards(playing_env(chosen, None))
    ((total, length),) = play_episodes(load_to_play("a2c", chosen.path, env, "cpu"), env, 1)
    # Every reward of CartPole is 1, and the statistics stay as training left them.
    one = float(unwrap_vec_normalize(env).normalize_reward(np.ones(1))[0])
    assert total == pytest.approx(length * one, rel=1e-5) != length
    env.close()


SAID = ("args.yml", "config.yml")
REFUSED = [
    ((), {}, "is in no run folder: say what it is with --algo"),
    (
        (),
        {"algo": "a2c", "env_id": CART},
        r"trained on observations of shape \(8,\), and the environment .* gives shape \(4,\)",
    ),
    (SAID, {}, "name their file with --vec-normalize"),
    ((*SAID, "vec_normalize.pkl"), {"algo": "dqn"}, "cannot be loaded as a dqn agent"),
]


@pytest.mark.parametrize(("settings", "given", "complaint"), REFUSED)
def test_what_does_not_go_together(zoo, tmp_path, settings, given, complaint):
    folder = hub(zoo, tmp_path, *settings)
    with pytest.raises(UserError, match=complaint) as refused:
        returns_of(ModelRequest(folder, **given), 1)
    assert "\n" not in str(refused.value)


WAYS_OUT = {  # setting: what stands in its place, and what the complaint ends with
    "policy_class": (Policy, "to admit a class of yours, name its module: --gym-packages MODULE"),
    "learning_rate": (fallen, "continues with another value: -params learning_rate:3e-4"),
    "clip_range": (fallen, "continues with another value: -params clip_range:VALUE"),
    "_n_updates": (Policy, "test_chosen_models.Policy, which may not stand in such a file"),
}


@pytest.mark.parametrize("key", WAYS_OUT)
def test_a_setting_that_is_code_is_refused_with_a_way_out(tmp_path, key):
    value, end = WAYS_OUT[key]
    model = PPO("MlpPolicy", CART, policy_kwargs={"net_arch": [4]}, device="cpu")
    setattr(model, key, value)
    model.save(tmp_path / "model")
    with pytest.raises(UserError) as refused:
        load_model("ppo", tmp_path / "model.zip", device="cpu")
    assert str(refused.value).endswith(end)


def read_config(tmp_path, text):
    path = tmp_path / "config.yml"
    path.write_text(text)
    return read_saved_settings(path)


APPLY = "!!python/object/apply:"


def test_an_ordered_dict_is_read_as_data(tmp_path):
    settings = read_config(tmp_path, yaml.dump(CONFIG))
    assert settings == dict(CONFIG)
    assert type(settings) is dict
    text = f"{APPLY}collections.OrderedDict [[[a, {APPLY}os.getcwd []]]]"
    with pytest.raises(UserError, match="is not allowed here"):
        read_config(tmp_path, text)


@pytest.mark.parametrize("name", ["../elsewhere", None])
def test_a_record_cannot_lead_out_of_its_folder_and_a_damaged_one_is_not_none(tmp_path, name):
    """The zip beside it would be played as if nobody had said what it was."""
    assert run_of(tmp_path / "any.zip") is None
    record = "{" if name is None else json.dumps({"env_name": name})
    (tmp_path / "run.json").write_text(record)
    said = r"run\.json is damaged" + (": env_name is " if name is not None else "")
    with pytest.raises(UserError, match=said):
        run_of(tmp_path / "any.zip")

"""Which model is played or trained further, what belongs to it, and folders of others."""

import io
import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize, unwrap_vec_normalize

from rl_yardstick.pipeline import models
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.models import Wanted, find_model, load_agent, model_in
from rl_yardstick.pipeline.playing import play_episodes, playing_env
from tests.pipeline.short_runs import CART, run_of, spec_of

SMALL_A2C = {"policy_kwargs": {"net_arch": [4]}, "n_envs": 2, "n_steps": 10}
SMALL_DQN = {"policy_kwargs": {"net_arch": [4]}, "learning_starts": 10, "buffer_size": 500}
SMALL_DQN |= {"batch_size": 4, "n_envs": 1}
BRIEFLY = {"eval_episodes": 2, "final_episodes": 2, "n_eval_envs": 1}


class Policy:
    """Of a stranger."""


def fallen(progress):
    return 1e-3 * progress


def train_to(folder, algo, entry, n_timesteps=200, **fields):
    spec = spec_of(algo, CART, entry, n_timesteps=n_timesteps, **BRIEFLY, **fields)
    return run_of(spec, folder)[0]


def read(path):
    return pickle.loads(path.read_bytes())


def seen(path):
    """How many observations the statistics are of, the start of 1e-4 left out."""
    return round(read(path).obs_rms.count)


def test_which_model_of_which_run(tmp_path):
    runs = [train_to(tmp_path, "a2c", SMALL_A2C, 60, save_freq=20, seed=i) for i in range(2)]
    found = {"algo": "a2c", "env_id": CART, "log_folder": tmp_path}
    assert find_model(Wanted(**found)).path == runs[1].path / "CartPole-v1.zip"
    assert find_model(Wanted(**found, number=1)).run == runs[0].path
    for which, name in {
        "best": "best_model.zip",
        "last checkpoint": "rl_model_60_steps.zip",
        40: "rl_model_40_steps.zip",
    }.items():
        assert find_model(Wanted(runs[0].path, which=which)).path.name == name
    for wanted, said in (
        (Wanted(**found, number=5), "no run 5 of a2c on CartPole-v1 in .*: there is 1, 2"),
        (Wanted(**found, which=30), "no rl_model_30_steps.zip: there are checkpoints after 20, 40"),
        (Wanted(algo="dqn", log_folder=tmp_path), "CartPole-v1 --algo dqn makes one"),
        (Wanted(algo="dnq", log_folder=tmp_path), "unknown agent 'dnq'"),
        (Wanted(tmp_path / "none.zip"), r"none\.zip: no such file"),
        (Wanted(runs[0].path / "run.json"), "run.json is no agent's zip: it is no whole zip: "),
        (Wanted(runs[0].path / "best_model.zip", which="best"), "is one model"),
    ):
        with pytest.raises(UserError, match=said):
            find_model(wanted)
    (runs[0].path / "run.json").write_text("{}")
    with pytest.raises(UserError, match=r"folder of this version: it has no run\.json with a spec"):
        find_model(Wanted(Path(runs[0].path)))


@pytest.fixture(scope="module")
def normalised(tmp_path_factory):
    """A run of 200 steps with checkpoints after 60, 120 and 180."""
    entry = {**SMALL_A2C, "normalize": {"clip_obs": 3.0}}
    return train_to(tmp_path_factory.mktemp("logs"), "a2c", entry, save_freq=60, eval_freq=40)


def test_a_model_is_played_on_the_statistics_of_its_moment(normalised):
    for which, name, n_seen in (
        # Two observations at the beginning, and two for each step of both environments.
        ("final", "CartPole-v1/vecnormalize.pkl", [202]),
        ("best", "best_model_vecnormalize.pkl", range(42, 203, 40)),
        ("last checkpoint", "rl_model_vecnormalize_180_steps.pkl", [182]),
        (60, "rl_model_vecnormalize_60_steps.pkl", [62]),
    ):
        path = normalised.path / name
        assert seen(path) in n_seen
        chosen = find_model(Wanted(normalised.path, which=which))
        assert chosen.statistics == path
        assert find_model(Wanted(chosen.path)).statistics == path


def test_statistics_go_on_unless_the_new_entry_has_none(normalised, tmp_path):
    fields = {"trained_agent": str(normalised.path / "rl_model_60_steps.zip"), "eval_freq": -1}
    run = train_to(tmp_path / "on", "a2c", SMALL_A2C, 40, **fields)
    assert seen(run.path / CART / "vecnormalize.pkl") == 104  # two for the new beginning
    # Where the entry has nothing, the agent's own settings count.
    assert read(run.path / CART / "vecnormalize.pkl").clip_obs == 3.0
    assert run.spec().normalize["clip_obs"] == 3.0
    # Statistics beside an agent that was trained without any are another's.
    plain = train_to(tmp_path / "plain", "a2c", SMALL_A2C, 40, eval_freq=-1)
    saved = run.path / CART / "vecnormalize.pkl"
    (plain.path / "vecnormalize.pkl").write_bytes(saved.read_bytes())
    fields["trained_agent"] = str(model_in(plain.path))
    assert train_to(tmp_path / "off", "a2c", SMALL_A2C, 40, **fields).spec().normalize is None
    run = train_to(tmp_path / "new", "a2c", {**SMALL_A2C, "normalize": {}}, 40, **fields)
    assert seen(run.path / CART / "vecnormalize.pkl") == 42


@pytest.mark.parametrize("name", ["vec_normalize.pkl", f"{CART}/vecnormalize.pkl"])
def test_statistics_beside_a_lone_zip_are_its_own(normalised, tmp_path, name):
    saved, lone = tmp_path / name, {"path": tmp_path / f"{CART}.zip", "algo": "a2c", "env_id": CART}
    lone["path"].write_bytes((normalised.path / f"{CART}.zip").read_bytes())
    for place in (saved, other := tmp_path / "another" / "vecnormalize.pkl"):
        place.parent.mkdir(exist_ok=True)
        place.write_bytes((normalised.path / CART / "vecnormalize.pkl").read_bytes())
    assert other.exists()
    found = find_model(Wanted(**lone))
    assert (found.statistics, found.spec.normalize["clip_obs"]) == (saved, 3.0)
    saved.unlink()
    for wanted in (Wanted(**lone), Wanted(normalised.path, statistics=Path("none"))):
        found = find_model(wanted)
        assert (found.statistics, found.spec.normalize) == (None, None)


def test_statistics_of_other_observations_are_refused_with_a_way_out(normalised, tmp_path):
    path = tmp_path / "other.pkl"
    for other, keys, said in (
        ("Pendulum-v1", None, r"\(3,\); the environment gives \(4,\): --vec-normalize"),
        (SimpleMultiObsEnv, ["vec"], r"normalize: `norm_obs_keys` .* the environment gives Box"),
    ):
        VecNormalize(make_vec_env(other), norm_obs_keys=keys).save(str(path))
        with pytest.raises(UserError, match=said):
            returns_of(Wanted(normalised.path, statistics=path), 1)


def test_a_training_begins_with_the_statistics_that_it_names(normalised, tmp_path):
    begun = {"trained_agent": str(normalised.path / "rl_model_60_steps.zip"), "eval_freq": -1}
    last, console = normalised.path / CART / "vecnormalize.pkl", Console(file=io.StringIO())
    console.width = 300
    spec = spec_of("a2c", CART, SMALL_A2C, n_timesteps=40, vec_normalize=str(last), **begun)
    run, _ = run_of(spec, tmp_path, console=console)
    assert f"note: normalised by the statistics in {last}\n" in console.file.getvalue()
    assert seen(run.path / CART / "vecnormalize.pkl") == 202 + 42
    run = train_to(tmp_path, "a2c", SMALL_A2C, 40, vec_normalize="none", **begun)
    assert run.spec().normalize is None


def test_replay_buffers_lie_where_the_library_and_rl_zoo3_have_them_and_go_on(tmp_path):
    fields = {"save_replay_buffer": True, "eval_freq": -1}
    first = train_to(tmp_path / "first", "dqn", SMALL_DQN, save_freq=80, **fields)
    of_80, of_160 = (f"rl_model_replay_buffer_{n}_steps.pkl" for n in (80, 160))
    names = {path.name for path in first.path.glob("*.pkl")}
    assert names == {"replay_buffer.pkl", of_160, of_80}
    for model, name in (
        ("CartPole-v1.zip", "replay_buffer.pkl"),
        ("rl_model_80_steps.zip", of_80),
        ("best_model.zip", "replay_buffer.pkl"),
    ):
        assert models.replay_buffer_of(first.path / model) == first.path / name
    fields["trained_agent"] = str(model_in(first.path))
    run = train_to(tmp_path / "next", "dqn", SMALL_DQN, 50, **fields)
    before, after = (read(one.path / "replay_buffer.pkl") for one in (first, run))
    # An update follows every fourth step, and training ends with one.
    assert (before.pos, after.pos) == (200, 252)
    np.testing.assert_array_equal(after.observations[:200], before.observations[:200])
    said = r"ReplayBuffer of n_envs:1 .* need a ReplayBuffer of n_envs:2"
    with pytest.raises(UserError, match=said):
        train_to(tmp_path / "no", "dqn", {**SMALL_DQN, "n_envs": 2}, 50, **fields)
    assert not (tmp_path / "no").exists()
    # Playing needs none.
    chosen = find_model(Wanted(first.path))
    env = playing_env(chosen, None)
    assert load_agent(chosen, env).replay_buffer.buffer_size == 1
    env.close()


CONFIG = OrderedDict(frame_stack=2, learning_rate="lin_0.1", n_envs=2, n_timesteps=1e5)
CONFIG |= {"normalize": "dict(norm_obs=True, norm_reward=False)", "policy": "MlpPolicy"}
CONFIG |= {"policy_kwargs": "dict(net_arch=[4], activation_fn=nn.ReLU)"}


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
    chosen = find_model(request)
    env = playing_env(chosen, None, n_envs)
    model = load_agent(chosen, env)
    env.seed(0)
    played = [episode[:2] for episode in play_episodes(model, env, n_episodes)]
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
        Wanted(algo="a2c", env_id="CartPole-v1", log_folder=zoo),
        Wanted(run / "CartPole-v1", log_folder=zoo),
        Wanted(run / "CartPole-v1.zip", log_folder=zoo),
        Wanted(whole / "a2c-CartPole-v1"),
    ):
        assert returns_of(request, 7, 3) == expected
    # Named statistics are used where the folder says no more than that two frames are stacked.
    for name in ("args.yml", "vec_normalize.pkl"):
        (whole / name).unlink()
    (whole / "config.yml").write_text("frame_stack: 2")
    saved = run / "CartPole-v1" / "vecnormalize.pkl"
    named = Wanted(whole, "a2c", "CartPole-v1", statistics=saved)
    assert returns_of(named, 7, 3) == expected
    assert find_model(named).spec.normalize["clip_obs"] == 2.0


def test_returns_of_rewards_as_training_normalised_them(zoo):
    chosen = find_model(Wanted(algo="a2c", env_id=CART, log_folder=zoo))
    env = playing_env(chosen, None, norm_reward=True)
    ((total, length, _),) = play_episodes(load_agent(chosen, env), env, 1)
    # Every reward of CartPole is 1, and the statistics stay as training left them.
    one = float(unwrap_vec_normalize(env).normalize_reward(np.ones(1))[0])
    assert total == pytest.approx(length * one, rel=1e-5) != length
    env.close()


SAID, A2C_ON_CART = ("args.yml", "config.yml"), {"algo": "a2c", "env_id": CART}
REFUSED = [
    ((), {}, "is in no run folder: say what it is with --algo"),
    ((), A2C_ON_CART, r"trained on observations of size \(8,\), not Box\(.*: give its --env and"),
    (SAID, {}, "name their file with --vec-normalize"),
    ((*SAID, "vec_normalize.pkl"), {"algo": "dqn"}, "it is no dqn zip: try --algo ppo or a2c$"),
]


@pytest.mark.parametrize(("settings", "given", "complaint"), REFUSED)
def test_what_does_not_go_together(zoo, tmp_path, settings, given, complaint):
    folder = hub(zoo, tmp_path, *settings)
    with pytest.raises(UserError, match=complaint) as refused:
        returns_of(Wanted(folder, **given), 1)
    assert "\n" not in str(refused.value)


WAYS_OUT = {  # setting: what stands in its place, and what the complaint ends with
    "policy_class": (Policy, "to admit a class of yours, name its module: --gym-packages MODULE"),
    "learning_rate": (fallen, "continues with another value: -params learning_rate:VALUE"),
    "clip_range": (fallen, "continues with another value: -params clip_range:VALUE"),
    "_n_updates": (Policy, "test_models.Policy, which may not stand in such a file"),
}


@pytest.mark.parametrize("key", WAYS_OUT)
def test_a_setting_that_is_code_is_refused_with_a_way_out(tmp_path, key):
    value, end = WAYS_OUT[key]
    model = PPO("MlpPolicy", CART, policy_kwargs={"net_arch": [4]}, device="cpu")
    setattr(model, key, value)
    model.save(tmp_path / "model")
    with pytest.raises(UserError) as refused:
        models.load(spec_of("ppo", CART), tmp_path / "model.zip", None, device="cpu")
    assert str(refused.value).endswith(end)

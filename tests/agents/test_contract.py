"""What every hand-written agent keeps to, as a Stable-Baselines3 algorithm."""

import inspect
import json
import pickle
import zipfile
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
import torch as th

from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.agents.common.model_files import JsonAlgorithm
from tests.agents import trainings
from tests.agents.trainings import AGENTS, LAKE, Plain, assert_same, environment, state_of

PLANNING = {"value_iteration", "policy_iteration", "optimal"}
ALL = pytest.mark.parametrize("name", AGENTS)


def env_of(name, n_envs=2, seed=5):
    env_id, _ = AGENTS[name]
    is_late = env_id == trainings.SEGMENTS and "mabwiser" not in name
    return environment(env_id, n_envs, seed, **({"batch_size": 7} if is_late else {}))


def make(name, env=None, **settings):
    """Interpreted, as compiling takes long: that both loops agree is seen in `test_engines.py`."""
    has_engines = "engine" in inspect.signature(load_algorithm(name)).parameters
    engine = {"engine": "interpreted"} if has_engines else {}
    return trainings.make(name, env or env_of(name), **{**AGENTS[name][1], **engine, **settings})


def steady(name):
    """Constants instead of schedules, which go by what is left of a call."""
    settings = AGENTS[name][1]
    constants = {key: 0.3 for key, value in settings.items() if callable(value)}
    decay = {"exploration_decay": "constant"} if "exploration_decay" in settings else {}
    return {**constants, **decay}


@cache
def trained(name):
    """After 120 steps; nobody changes it."""
    return make(name, **steady(name)).learn(120)


def observations(model, n=30):
    """Every state, or random observations where there is no end to them."""
    space = model.observation_space
    if isinstance(space, gym.spaces.Discrete):
        return np.arange(n) % space.n
    space.seed(0)
    return np.stack([space.sample() for _ in range(n)])


def shown(value):
    """A setting; a schedule by what it says."""
    return [value(remaining) for remaining in (1.0, 0.4)] if callable(value) else value


def test_all_of_them_are_in_the_table():
    classes = {name: load_algorithm(name) for name in ALGORITHMS}
    assert {name for name, kind in classes.items() if issubclass(kind, JsonAlgorithm)} == {*AGENTS}


@ALL
def test_seeds_decide_calls_do_not_and_everything_is_counted(name):
    def of_all():
        return np.random.get_state()[1].tolist(), th.get_rng_state().tolist()  # noqa: NPY002

    before, model, counter = of_all(), make(name, **steady(name)), Plain()
    assert model.learn(39, callback=counter) is model
    assert model.num_timesteps == 40
    model.learn(80, callback=counter, reset_num_timesteps=False)
    again, whole = state_of(model), state_of(trained(name))
    for state in (again, whole):
        del state["counts"]  # each call has a total of its own
    assert_same(whole, again)
    assert of_all() == before
    assert model.num_timesteps == 120 == counter.n_calls * 2
    assert model._episode_num == sum(counter.ended)
    assert model._n_updates == trained(name)._n_updates
    endless = ALGORITHMS[name].for_bandits or AGENTS[name][0] == "MountainCar-v0"
    assert sum(counter.ended) > 0 or endless
    other = state_of(make(name, seed=2, **steady(name)).learn(120))
    assert other["generator"] != again["generator"] or name in {*PLANNING, "angle"}
    tables = {key for key in other if "." not in key} & {"scores", "sums", "coefficients"}
    assert any(other[key] != again[key] for key in tables) or not tables


@ALL
def test_zips_and_pickles_bring_everything_back_and_it_goes_on(name, tmp_path):
    model = make(name).learn(120)
    model.save(tmp_path / "agent")
    with zipfile.ZipFile(tmp_path / "agent.zip") as archive:
        data = archive.read("data").decode()
        assert archive.read("_stable_baselines3_version").decode() == stable_baselines3.__version__
        with archive.open("policy.pth") as file:
            th.load(file, weights_only=True)
    assert ":serialized:" not in data
    assert json.loads(data)["algorithm"] == type(model).__name__
    loaded = type(model).load(tmp_path / "agent")
    for key, value in AGENTS[name][1].items():
        assert shown(getattr(loaded, key)) == shown(value)
    if hasattr(model, "settings"):
        assert loaded.settings().tobytes() == model.settings().tobytes()
        assert loaded.exploration_rate == model.exploration_rate
    model.policy.save(str(tmp_path / "policy"))
    policy, obs = type(model.policy).load(str(tmp_path / "policy")), observations(model)
    for deterministic in (True, False) if name != "random" else (False,):
        expected = model.predict(obs, deterministic=deterministic)[0].tolist()
        assert loaded.predict(obs, deterministic=deterministic)[0].tolist() == expected
        if deterministic:
            assert policy.predict(obs, deterministic=True)[0].tolist() == expected
    model.env = None
    agents = model, loaded, pickle.loads(pickle.dumps(model))
    for agent in agents:
        agent.set_env(env_of(name, seed=1))
        assert agent.learn(100, reset_num_timesteps=False).num_timesteps == 220
    assert_same(*map(state_of, agents))
    other = type(model).load(tmp_path / "agent", env=env_of(name, 1))
    assert other.learn(50, reset_num_timesteps=False).num_timesteps == 170
    assert other.n_envs == 1


@ALL
def test_predict_takes_one_observation_or_many_and_arguments_have_names(name):
    model, many = trained(name), observations(trained(name))
    before = state_of(model)
    for deterministic in (True, False):
        actions, hidden = model.predict(many, deterministic=deterministic)
        assert actions.shape == (len(many),)
        assert hidden is None or name in PLANNING
        ones = [model.predict(each, deterministic=deterministic)[0] for each in many]
        assert {one.shape for one in ones} == {()}
        assert all(model.action_space.contains(int(one)) for one in ones)
        assert ones == actions.tolist() or not deterministic or name == "random"
    after = state_of(model)
    if name == "random":  # which draws from its space
        del before["action generator"], after["action generator"]
    assert_same(before, after)
    with pytest.raises(TypeError, match="nonsense"):
        make(name, nonsense=1)


def test_a_loaded_agent_can_go_on_in_an_episode(tmp_path):
    for name in ("sarsa", "monte_carlo", "reinforce"):
        env = environment(LAKE, 2)
        model = load_algorithm(name)(env=env, seed=1, engine="interpreted").learn(50)
        model.save(tmp_path / "model")
        loaded = type(model).load(tmp_path / "model", env, force_reset=False)
        assert loaded._last_obs.tolist() == model._last_obs.tolist()
        assert loaded.learn(50, reset_num_timesteps=False).num_timesteps == 100


def test_files_of_other_agents_are_refused(tmp_path):
    make("sarsa").save(tmp_path / "agent")
    with pytest.raises(ValueError, match="does not hold a QLearning"):
        load_algorithm("qlearning").load(tmp_path / "agent")


def test_functions_travel_in_the_zip_as_their_values(tmp_path):
    model = make("qlearning", learning_rate=lambda progress: 0.25 * progress).learn(500)
    with pytest.warns(UserWarning, match="learning_rate is a Python function"):
        model.save(tmp_path / "agent")
    loaded = type(model).load(tmp_path / "agent")
    assert loaded.learning_rate == pytest.approx(0.0, abs=1e-3)


DAMAGES = {  # agent: arrays, and what is written all over them
    "dyna_q_plus": {"next_obs": 16},
    "dyna_q": {"next_obs": -1, "pairs": 64, "n_pairs": 65, "counts": -1},
    "prioritized_sweeping": {
        "queue": 64, "place": 64, "n_queued": 65, "behind": 64, "before": -2, "first_into": 64},
    "r_max": {"next_obs": 16, "tallies": 2, "counts": 4, "states": 16, "n_states": 17},
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_arrays_are_refused(name, tmp_path):
    """Compiled code would read and write beside them."""
    model = make(name, engine="interpreted").learn(300)
    for array, value in DAMAGES[name].items():
        buffer = getattr(model.policy, f"model_{array}")
        right = buffer.clone()
        buffer.fill_(value)
        model.save(tmp_path / "agent")
        with pytest.raises(ValueError, match=r"^holds no "):
            type(model).load(tmp_path / "agent")
        buffer.copy_(right)
    model.save(tmp_path / "agent")
    type(model).load(tmp_path / "agent")


def test_damaged_lists_and_queues_come_to_an_end(tmp_path):
    """All pairs follow the fourth, which follows itself; and nothing says where the queue is."""
    model = make("prioritized_sweeping", engine="interpreted").learn(300)
    for array, value in {"behind": 3, "first_into": 3, "place": -1, "n_queued": 64}.items():
        getattr(model.policy, f"model_{array}").fill_(value)
    model.save(tmp_path / "agent")
    loaded = type(model).load(tmp_path / "agent", env=env_of("prioritized_sweeping"))
    assert loaded.learn(100).num_timesteps == 100

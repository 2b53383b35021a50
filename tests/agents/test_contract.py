"""What every hand-written agent keeps to, as a Stable-Baselines3 algorithm: one table of agents."""

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
from stable_baselines3.common.callbacks import (
    BaseCallback,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

import envs  # noqa: F401  # registers the environments
from agents import ALGORITHMS, load_algorithm
from agents.common.model_files import JsonAlgorithm
from agents.common.schedules import ExponentialSchedule

LAKE, COINS, SEGMENTS = "FrozenLake-v1", "BernoulliBandit-v0", "SegmentBandit-v0"
LATE = lambda: gym.make(SEGMENTS, batch_size=7)  # noqa: E731  # feedback comes in batches
CONSTANT = {"exploration_decay": "constant", "exploration_initial_eps": 0.4}
AGENTS = {  # where each is tried, and with which settings other than its own
    "qlearning": (LAKE, {**CONSTANT, "learning_rate": 0.5, "mask_actions": False}),
    "sarsa": (LAKE, {**CONSTANT, "learning_rate": "sample_average", "initial_q_std": 1.0}),
    "expected_sarsa": (LAKE, {"exploration": "boltzmann", "temperature": 0.3}),
    "double_qlearning": (LAKE, {**CONSTANT, "tie_breaking": "first"}),
    "n_step_sarsa": (LAKE, {**CONSTANT, "n_steps": 3}),
    "n_step_tree_backup": (LAKE, {**CONSTANT, "n_steps": 3, "target_policy": "greedy"}),
    "sarsa_lambda": (LAKE, {**CONSTANT, "trace_type": "dutch", "trace_decay": 0.5}),
    "q_lambda": (LAKE, {**CONSTANT, "trace_type": "accumulating"}),
    "monte_carlo": (LAKE, {**CONSTANT, "every_visit": True}),
    "off_policy_monte_carlo": (LAKE, CONSTANT),
    "dyna_q": (LAKE, {**CONSTANT, "outcomes_kept": 3, "skip_terminal_update": True}),
    "dyna_q_plus": (LAKE, {**CONSTANT, "kappa": 0.01, "learning_rate": "sample_average"}),
    "prioritized_sweeping": (LAKE, {**CONSTANT, "planning_steps": 1, "initial_q_std": 1.0}),
    "r_max": (LAKE, {"known_after": 3, "value_bound": 1.0}),
    "qlearning_ucb": (LAKE, {"value_bound": 1.0, "horizon": 30.0}),
    "semi_gradient_sarsa": ("MountainCar-v0", {**CONSTANT, "n_tilings": 4}),
    "semi_gradient_q": (LAKE, {**CONSTANT, "initial_q": 0.5}),
    "actor_critic": ("MountainCar-v0", {"n_tiles": [3, 4], "value_step_size": 0.2}),
    "reinforce": (LAKE, {"baseline": "value", "learning_rate": 0.5}),
    "value_iteration": (LAKE, {"gamma": 0.9}),
    "policy_iteration": (LAKE, {"gamma": 0.9}),
    "optimal": (LAKE, {}),
    "random": (LAKE, {}),
    "angle": ("CartPole-v1", {}),
    "epsilon_greedy": (LATE, {"initial_q": 3.0, "learning_rate": 0.2}),
    "boltzmann": (LATE, {"temperature": 0.7}),
    "ucb": (LATE, {"variant": "sutton_barto", "c": 0.5, "ignore_context": True}),
    "kl_ucb": (LATE, {"c": 2.0}),
    "gradient_bandit": (LATE, {"baseline": False, "learning_rate": 0.3}),
    "exp3": (LATE, {"mixing": 0.4}),
    "thompson": (LATE, {"likelihood": "gaussian", "prior_std": 3.0}),
    "linucb": (LATE, {"ridge": 2.0}),
    "lin_thompson": (LATE, {"alpha": 0.1}),
    "lin_epsilon_greedy": (LATE, CONSTANT),
    "mabwiser_epsilon_greedy": (COINS, {}),
    "mabwiser_ucb1": ("GaussianBandit-v0", {}),
    "mabwiser_thompson": (COINS, {}),
    "mabwiser_linucb": (SEGMENTS, {}),
}
PLANNING = {"value_iteration", "policy_iteration", "optimal"}
ALL = pytest.mark.parametrize("name", AGENTS)

pytestmark = pytest.mark.filterwarnings(
    "ignore:Training and eval env are not of the same type:UserWarning"
)


def environment(name, n_envs=1, seed=5, **kwargs):
    return make_vec_env(AGENTS[name][0], n_envs, seed=seed, **kwargs)


def make(name, env=None, **kwargs):
    settings = {"seed": 0, **AGENTS[name][1], **kwargs}
    algorithm = load_algorithm(name)
    return algorithm(next(iter(algorithm.policy_aliases)), env or environment(name), **settings)


def state(model):
    """All that training changes, in a form that can be compared."""
    tables = model.policy.state_dict().items()
    return {
        "tables": {
            key: value.numpy().tobytes() for key, value in tables if hasattr(value, "numpy")
        },
        "rng": model.rng.bit_generator.state,
        "counts": (model.num_timesteps, model._episode_num, model._n_updates),
        "returns": [episode["r"] for episode in model.ep_info_buffer or ()],
    }


@cache
def trained(name):
    """After 500 steps; nobody changes it."""
    return make(name).learn(500)


def observations(model, n=30):
    """Every state, or random observations where there is no end to them."""
    space = model.observation_space
    if isinstance(space, gym.spaces.Discrete):
        return np.arange(n) % space.n
    space.seed(0)
    return np.stack([space.sample() for _ in range(n)])


def test_all_of_them_are_in_the_table():
    classes = {name: load_algorithm(name) for name in ALGORITHMS}
    assert {name for name, kind in classes.items() if issubclass(kind, JsonAlgorithm)} == {*AGENTS}


@ALL
def test_seeds_decide_calls_do_not_and_global_generators_are_left_alone(name):
    def of_all():
        return np.random.get_state()[1].tolist(), th.get_rng_state().tolist()  # noqa: NPY002

    before, model = of_all(), make(name)
    assert model.learn(200) is model
    assert state(model.learn(300, reset_num_timesteps=False)) == state(trained(name))
    assert of_all() == before
    other = make(name, seed=1).learn(500)
    assert state(other) != state(model)
    if "bandit" in ALGORITHMS[name].entry_point:
        assert state(other)["tables"] != state(model)["tables"]


@pytest.mark.parametrize("n_envs", [1, 3])
@ALL
def test_steps_episodes_and_updates_are_counted_over_all_environments(name, n_envs):
    seen = []

    class CountDones(BaseCallback):
        def _on_step(self):
            seen.append(int(self.locals["dones"].sum()))
            return True

    model = make(name, environment(name, n_envs)).learn(301, callback=CountDones())
    assert model.num_timesteps == -(-301 // n_envs) * n_envs
    assert len(seen) == model.num_timesteps // n_envs
    assert model._episode_num == sum(seen)
    assert sum(seen) > 0 or ALGORITHMS[name].for_bandits or AGENTS[name][0] == "MountainCar-v0"


@ALL
def test_zips_and_pickles_bring_everything_back_and_it_goes_on(name, tmp_path):
    model = make(name).learn(500)
    model.save(tmp_path / "agent")
    with zipfile.ZipFile(tmp_path / "agent.zip") as archive:
        data = archive.read("data").decode()
        assert archive.read("_stable_baselines3_version").decode() == stable_baselines3.__version__
        with archive.open("policy.pth") as file:
            th.load(file, weights_only=True)
    assert ":serialized:" not in data
    assert json.loads(data)["algorithm"] == type(model).__name__
    algorithm = type(model)
    loaded = algorithm.load(tmp_path / "agent")
    model.policy.save(str(tmp_path / "policy"))
    policy = type(model.policy).load(str(tmp_path / "policy"))
    assert state(loaded) == state(model)
    for key, value in AGENTS[name][1].items():
        assert getattr(loaded, key) == value
    if hasattr(model, "settings"):
        assert loaded.settings().tobytes() == model.settings().tobytes()
        assert loaded.lr_schedule(0.5) == model.lr_schedule(0.5)
        assert loaded.exploration_rate == model.exploration_rate
    obs = observations(model)
    for deterministic in (True, False):
        if name == "random" and deterministic:
            continue
        expected = model.predict(obs, deterministic=deterministic)[0].tolist()
        assert loaded.predict(obs, deterministic=deterministic)[0].tolist() == expected
    if name != "random":
        expected = model.policy.predict(obs, deterministic=True)[0]
        np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], expected)
    model.env = None
    agents = model, loaded, pickle.loads(pickle.dumps(model))
    for agent in agents:
        agent.set_env(environment(name, seed=1))
        assert agent.learn(200, reset_num_timesteps=False).num_timesteps == 700
    assert state(agents[1]) == state(model) == state(agents[2])
    other = algorithm.load(tmp_path / "agent", env=environment(name, 2))
    assert other.learn(200, reset_num_timesteps=False).num_timesteps == 700
    assert other.n_envs == 2


@ALL
def test_predict_takes_one_observation_or_many_and_changes_nothing(name):
    for model in (trained(name), make(name)):
        before, many = state(model), observations(model)
        for deterministic in (True, False):
            actions, hidden = model.predict(many, deterministic=deterministic)
            assert actions.shape == (len(many),)
            assert hidden is None or name in PLANNING
            ones = [model.predict(each, deterministic=deterministic)[0] for each in many]
            assert {one.shape for one in ones} == {()}
            assert all(model.action_space.contains(int(one)) for one in ones)
            assert ones == actions.tolist() or not deterministic or name == "random"
        assert state(model) == before


@ALL
def test_signatures_name_every_argument(name):
    """Hyperparameter files are checked against them."""
    parameters = inspect.signature(load_algorithm(name)).parameters
    assert not [p for p in parameters.values() if p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    common = {"policy", "env", "seed", "verbose", "device", "tensorboard_log", *AGENTS[name][1]}
    assert common <= set(parameters)
    with pytest.raises(TypeError, match="nonsense"):
        make(name, nonsense=1)


# --- the library's services ----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["sarsa", "actor_critic", "ucb"])
def test_training_under_other_vec_envs(name):
    forks = {"start_method": "fork"}  # they would import for seconds
    env = environment(name, 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=forks)
    parallel = make(name, env).learn(200)
    env.close()
    assert state(parallel) == state(make(name, environment(name, 2)).learn(200))
    normalized = VecNormalize(environment(name, 2), norm_obs=False)
    assert make(name, normalized).learn(200).num_timesteps == 200
    bare = DummyVecEnv([lambda: environment(name).envs[0].unwrapped])  # no Monitor
    assert make(name, bare).learn(100).num_timesteps == 100


def test_another_environment_is_begun_anew():
    model, env = make("qlearning").learn(100), environment("qlearning", seed=9)
    model.set_env(env)
    assert model._last_obs is None
    assert model.learn(100, reset_num_timesteps=False).get_env() is env


@pytest.mark.parametrize("name", ["sarsa", "monte_carlo", "actor_critic", "reinforce"])
def test_a_loaded_agent_can_go_on_in_the_middle_of_episodes(name, tmp_path):
    env = make_vec_env(LAKE, 2, seed=3)
    model = load_algorithm(name)(env=env, seed=1, engine="interpreted").learn(50)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env, force_reset=False)
    assert loaded._last_obs.tolist() == model._last_obs.tolist()
    assert loaded.learn(50, reset_num_timesteps=False).num_timesteps == 100


# --- what files keep -----------------------------------------------------------------------------


def test_a_table_of_another_agent_is_refused(tmp_path):
    make("sarsa").save(tmp_path / "agent")
    with pytest.raises(ValueError, match="does not hold a QLearning"):
        load_algorithm("qlearning").load(tmp_path / "agent")


def test_schedules_travel_in_the_zip_and_functions_as_their_values(tmp_path):
    model = make("qlearning", learning_rate=ExponentialSchedule(0.5, 0.1), seed=None)
    model.save(tmp_path / "agent")
    loaded = type(model).load(tmp_path / "agent")
    assert loaded.lr_schedule(0.5) == pytest.approx((0.5 * 0.1) ** 0.5)
    model = make("qlearning", learning_rate=lambda progress: 0.25 * progress).learn(500)
    with pytest.warns(UserWarning, match="learning_rate is a Python function"):
        model.save(tmp_path / "agent")
    loaded = type(model).load(tmp_path / "agent")
    assert loaded.learning_rate == pytest.approx(0.0, abs=1e-3)


DAMAGES = [
    ("off_policy_monte_carlo", "weights", None, r"weights must be of shape \(1, 16, 4\)"),
    *((name, "model_next_obs", 16, "^holds no ") for name in ("dyna_q_plus", "r_max")),
    ("dyna_q", "model_next_obs", -1, "^holds no "),
    ("dyna_q", "model_pairs", 64, "^holds no "),
    ("dyna_q", "model_n_pairs", 65, "^holds no "),
    ("dyna_q", "model_counts", -1, "^holds no "),
    ("prioritized_sweeping", "model_queue", 64, "^holds no "),
    ("prioritized_sweeping", "model_queue", 0, "^holds no "),
    ("prioritized_sweeping", "model_place", -1, "^holds no "),
    ("prioritized_sweeping", "model_n_queued", 64, "^holds no "),
    ("prioritized_sweeping", "model_behind", 3, "^holds no "),
    ("prioritized_sweeping", "model_before", 3, "^holds no "),
    ("prioritized_sweeping", "model_first_into", 3, "^holds no "),
    ("r_max", "model_tallies", 2, "^holds no "),
    ("r_max", "model_counts", 4, "^holds no "),
    ("r_max", "model_states", 16, "^holds no "),
    ("r_max", "model_n_states", 17, "^holds no "),
]


@pytest.mark.parametrize(("name", "array", "value", "line"), DAMAGES)
def test_damaged_arrays_are_refused(name, array, value, line, tmp_path):
    """Compiled code would read and write beside them, or never come to an end."""
    model = make(name, engine="interpreted").learn(300)
    buffer = getattr(model.policy, array)
    if value is None:
        setattr(model.policy, array, buffer[:, :2].clone())
        with pytest.raises(ValueError, match=line):
            model.learn(10)
        return
    buffer.fill_(value)
    model.save(tmp_path / "agent")
    with pytest.raises(ValueError, match=line):
        type(model).load(tmp_path / "agent")


def test_a_model_of_another_number_of_outcomes_is_refused(tmp_path):
    make("dyna_q").save(tmp_path / "agent")
    with pytest.raises(ValueError, match=r"room for 3 outcomes of .* the settings ask for 1"):
        load_algorithm("dyna_q").load(tmp_path / "agent.zip", outcomes_kept=1)

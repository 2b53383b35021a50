"""What compiled networks do not do: refused in one line, or left to the library."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize
from torch import nn

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from envs.wrappers import ActionMasks


class Any(gym.Env):
    """An environment of any spaces."""

    def __init__(self, observations=None, actions=None):
        self.observation_space = observations or spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = actions or spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.5, bool(self.np_random.random() < 0.1), False, {}


class OwnDQN(load_algorithm("dqn")):
    """A user's own."""

    def train(self, gradient_steps, batch_size=100):
        pass


DICT = spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Discrete(3)})
IMAGE = spaces.Box(0, 255, (36, 36, 1), np.uint8)
OFFSET = spaces.Discrete(4, start=1)


def with_env(name, env, policy="MlpPolicy", **kwargs):
    return lambda **more: load_algorithm(name)(policy, env(), device="cpu", **kwargs, **more)


def with_policy(name, **policy_kwargs):
    return with_env(name, Any, policy_kwargs=policy_kwargs)


SMALL = {"buffer_size": 100, "learning_starts": 10}
ADAM = {"optimizer_kwargs": {"amsgrad": True}}
REFUSALS = {
    "masks": (
        with_env("dqn", lambda: ActionMasks(gym.make("Warehouse-v0")), mask_actions=True),
        "it masks actions",
    ),
    "continuous": (
        with_env("ppo", lambda: gym.make("Pendulum-v1")),
        "actions are Box, not Discrete",
    ),
    "images": (
        with_env("dqn", lambda: Any(IMAGE), "CnnPolicy", **SMALL),
        "observations are of uint8",
    ),
    "dict": (
        with_env("ppo", lambda: Any(DICT), "MultiInputPolicy"),
        "observations are Dict, not Box or Discrete",
    ),
    "an offset": (
        with_env("dqn", lambda: Any(actions=OFFSET), **SMALL),
        r"Discrete\(4, start=1\) does not begin with 0",
    ),
    "integers": (
        with_env("ppo", lambda: Any(spaces.Box(0, 9, (3,), np.int64))),
        "observations are of int64",
    ),
    "Hardtanh": (
        with_policy("ppo", activation_fn=nn.Hardtanh),
        "a network has a layer of Hardtanh",
    ),
    "ELU": (with_policy("dqn", activation_fn=nn.ELU), "a network has a layer of ELU"),
    "NAdam": (
        with_policy("ppo", optimizer_class=th.optim.NAdam),
        "its optimizer is NAdam, not Adam or RMSprop",
    ),
    "amsgrad": (with_policy("dqn", **ADAM), "its optimizer has amsgrad True"),
    "of one's own": (
        lambda **more: OwnDQN("MlpPolicy", Any(), **more),
        "OwnDQN may do things in Python of its own",
    ),
    "less memory": (
        with_env(
            "dqn",
            Any,
            optimize_memory_usage=True,
            replay_buffer_kwargs={"handle_timeout_termination": False},
            **SMALL,
        ),
        "its replay buffer is of another kind",
    ),
    "episodes of several": (
        with_env("dqn", lambda: make_vec_env(Any, 2), train_freq=(1, "episode"), **SMALL),
        "train_freq counts the episodes of several environments",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_compiled_says_why_not(case):
    make, reason = REFUSALS[case]
    model = make(engine="compiled")
    with pytest.raises(ValueError, match=f"^engine: compiled is not possible: {reason}$"):
        model.learn(30)
    assert model.num_timesteps == 0


@pytest.mark.parametrize("case", ["masks", "Hardtanh", "NAdam", "of one's own", "dict"])
def test_auto_falls_back_and_says_so(case):
    make, reason = REFUSALS[case]
    short = {} if case in {"masks", "of one's own"} else {"n_steps": 16, "batch_size": 16}
    model = make(engine="auto", **short).learn(30)
    assert model.engine_in_use == f"library: {reason}"
    assert model.num_timesteps >= 30


def test_sde_is_refused():
    # The library refuses it for discrete actions, which are all that compiled code takes.
    with pytest.raises(ValueError, match="State-Dependent"):
        load_algorithm("ppo")("MlpPolicy", Any(), use_sde=True, engine="compiled")


def test_frozen_parameters_are_refused():
    model = load_algorithm("ppo")("MlpPolicy", Any(), engine="compiled")
    model.policy.value_net.weight.requires_grad_(False)
    with pytest.raises(ValueError, match="some of its parameters are frozen"):
        model.learn(10)


def test_an_unknown_engine_is_refused():
    with pytest.raises(ValueError, match="engine"):
        load_algorithm("ppo")("MlpPolicy", Any(), engine="fast")


def test_the_library_is_the_default():
    model = load_algorithm("dqn")("MlpPolicy", Any(), **SMALL).learn(30)
    assert model.engine_in_use == "library"


# --- compiled but for the environment ------------------------------------------------------------


class Plain(BaseCallback):
    """Has to be asked after each step."""

    def _on_step(self):
        return True


FALLBACKS = {
    "unknown": (Any, {}, None, "the environment's transition model is not known"),
    "callback": (
        lambda: gym.make("FrozenLake-v1"),
        {},
        Plain,
        "Plain must be asked after each step",
    ),
    "function": (
        lambda: gym.make("FrozenLake-v1"),
        {},
        lambda: lambda locals_, globals_: True,
        "a function must be asked after each step",
    ),
    "rate": (
        lambda: gym.make("FrozenLake-v1"),
        {"learning_rate": lambda remaining: 0.01 * remaining},
        None,
        "a schedule is a Python function",
    ),
}


@pytest.mark.parametrize("name", ["dqn", "ppo"])
@pytest.mark.parametrize("case", FALLBACKS)
def test_environments_are_called_where_they_have_to_be(case, name):
    make_env, kwargs, callback, reason = FALLBACKS[case]
    own = {"n_steps": 32, "batch_size": 32} if name == "ppo" else SMALL
    model = load_algorithm(name)("MlpPolicy", make_env(), engine="compiled", **own, **kwargs)
    callback = callback and callback()
    model.learn(64, callback=callback)
    assert model.engine_in_use == f"compiled but for the environment: {reason}"
    assert model._n_updates > 0
    assert str(model.engine_plan(10**6, callback, "auto")) == model.engine_in_use


def test_clip_ranges_in_python_are_asked_at_each_training():
    asked = []
    model = load_algorithm("ppo")(
        "MlpPolicy",
        gym.make("FrozenLake-v1"),
        n_steps=32,
        batch_size=32,
        engine="compiled",
        clip_range=lambda remaining: (asked.append(remaining), 0.1 + 0.1 * remaining)[1],
    )
    model.learn(96)
    assert model.engine_in_use.endswith("a schedule is a Python function")
    assert {round(remaining, 6) for remaining in asked} >= {round(i / 3, 6) for i in range(3)}
    assert model.logger.name_to_value["train/clip_range"] == pytest.approx(0.1)


@pytest.mark.parametrize("name", ["ppo", "a2c"])
def test_normalised_environments(name):
    """What is learnt from is normalised as it was on the way, and the statistics are kept."""
    env = VecNormalize(make_vec_env("CartPole-v1", 2, seed=0))
    model = load_algorithm(name)("MlpPolicy", env, n_steps=64, engine="compiled", seed=0)
    seen = []

    class Watch(BaseCallback):
        def _on_step(self):
            seen.append((self.model._last_obs.copy(), self.locals["rewards"].copy()))
            return True

    model.learn(256, callback=Watch())
    assert model.engine_in_use.startswith("compiled but for the environment")
    assert env.obs_rms.count == pytest.approx(256 + 2, abs=0.01)
    buffer, last = model.rollout_buffer, seen[-64:]
    shown = np.array([observations for observations, _ in last])
    np.testing.assert_array_equal(buffer.observations, shown.astype(np.float32))
    # No time limit has run out: these are the rewards as they were normalised.
    np.testing.assert_array_equal(buffer.rewards, np.array([rewards for _, rewards in last]))
    assert np.abs(buffer.rewards - 1).max() > 0.01


@pytest.mark.parametrize("name", ["dqn", "double_dqn"])
def test_normalised_environments_whose_buffer_is_not(name):
    """It acts on what is normalised, and keeps what was there before."""
    env = VecNormalize(make_vec_env("CartPole-v1", 2, seed=0))
    model = load_algorithm(name)(
        "MlpPolicy", env, engine="compiled", seed=0, **{**SMALL, "buffer_size": 400}
    )
    seen = []

    class Watch(BaseCallback):
        def _on_step(self):
            seen.append((self.training_env.get_original_obs(), self.locals["new_obs"]))
            return True

    model.learn(100, callback=Watch())
    assert model.engine_in_use.startswith("compiled but for the environment")
    assert model._n_updates > 0
    buffer, last = model.replay_buffer, len(seen) - 1
    np.testing.assert_array_equal(buffer.observations[last], seen[-2][0])
    assert np.abs(seen[-1][0] - seen[-1][1]).max() > 0.01
    np.testing.assert_array_equal(buffer.rewards[: len(seen)], 1)
    rules, memory = model_rules(model)
    np.testing.assert_array_equal(memory.centre, env.obs_rms.mean)
    assert rules["reward_spread"] == np.sqrt(env.ret_rms.var + env.epsilon)


def model_rules(model):
    """What a training would go by now."""
    with model._learning_compiled():
        training = model._shared_training()
        training.read_settings()
        return training.held.rules[0], training.memory.held


def test_processes_of_their_own():
    forks = {"start_method": "fork"}  # they would import for seconds
    env = make_vec_env("CartPole-v1", 2, 0, vec_env_cls=SubprocVecEnv, vec_env_kwargs=forks)
    model = load_algorithm("a2c")("MlpPolicy", env, engine="compiled").learn(50)
    env.close()
    reason = "SubprocVecEnv is not DummyVecEnv"
    assert model.engine_in_use == f"compiled but for the environment: {reason}"


class Lying(Any):
    """Leaves its own observation space, at the end of an episode or at once."""

    def __init__(self, at_end):
        super().__init__(spaces.Discrete(3))
        self.at_end = at_end

    def step(self, action):
        return 3, 0.0, self.at_end, False, {}


@pytest.mark.parametrize("at_end", [False, True])
@pytest.mark.parametrize("name", ["dqn", "ppo"])
def test_states_that_networks_have_no_weights_for_are_refused(name, at_end):
    """Compiled code would read whatever lies behind the weights."""
    model = load_algorithm(name)("MlpPolicy", Lying(at_end), engine="compiled")
    if name == "ppo" and at_end:
        model.learn(100)  # nobody looks at what an episode has ended with
        return
    with pytest.raises(ValueError, match=r"observation 3 is not in Discrete\(3\)"):
        model.learn(100)


class Broken(Any):
    """Shows something that is not a number."""

    def step(self, action):
        return np.full(2, np.nan, np.float32), 0.0, False, False, {}


@pytest.mark.parametrize("name", ["ppo", "a2c"])
def test_a_training_that_diverges_is_ended(name):
    model = load_algorithm(name)("MlpPolicy", Broken(), n_steps=64, engine="compiled")
    with pytest.raises(ValueError, match="training has diverged"):
        model.learn(100)


def test_weights_that_are_not_numbers_are_seen():
    model = load_algorithm("dqn")("MlpPolicy", Broken(), engine="compiled", **SMALL).learn(100)
    assert all(bool(p.isnan().all()) for p in model.q_net.parameters())

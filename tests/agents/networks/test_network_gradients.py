"""Compiled updates against the library's own ``train``, from equal weights and equal minibatches.

Measured is the norm of the difference against the norm of the whole: Adam divides gradients by
their own size, so that a weight whose gradients all but vanish goes where rounding takes it, as far
as any other goes, and single weights tell little of how well the rest agrees.
"""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import example, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn

from agents import load_algorithm
from agents.networks.policy_gradients import estimate_advantages
from tests.agents.networks.as_compiled import draw_as_compiled

N_ACTIONS = 3
TOLERANCE = 1e-5
FUNCTIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "identity": nn.Identity}
widths = st.lists(st.integers(1, 70), max_size=3)


class Nowhere(gym.Env):
    """Something to make an agent for."""

    action_space = spaces.Discrete(N_ACTIONS)

    def __init__(self, observations):
        self.observation_space = observations

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}


NUMBERS = spaces.Discrete(7)
VECTORS = spaces.Box(-1, 1, (2, 2), np.float32)
DOUBLES = spaces.Box(-1, 1, (3,), np.float64)


def make(name, engine, observations, n_envs=2, policy_kwargs=None, **kwargs):
    env = make_vec_env(Nowhere, n_envs, env_kwargs={"observations": observations})
    return load_algorithm(name)(
        "MlpPolicy", env, seed=0, engine=engine, policy_kwargs=policy_kwargs, **kwargs
    )


def fill(array, rng, observations):
    """Make up observations."""
    if isinstance(observations, spaces.Discrete):
        array[:] = rng.integers(observations.n, size=array.shape)
    else:
        array[:] = rng.normal(size=array.shape)


def parameters(model):
    return {name: value.numpy().copy() for name, value in model.policy.state_dict().items()}


def assert_same(ours, theirs):
    """Two sets of arrays agree."""
    assert ours.keys() == theirs.keys()
    apart = sum(np.sum((ours[name] - value) ** 2) for name, value in theirs.items())
    whole = sum(np.sum(value**2) for value in theirs.values())
    assert apart <= (TOLERANCE**2) * whole, np.sqrt(apart / whole)


def assert_same_optimizers(ours, theirs):
    """They remember the same, each kind of moment by itself."""
    states = [model.policy.optimizer.state_dict()["state"] for model in (ours, theirs)]
    names = {name for state in states[1].values() for name in state}
    for name in names:
        assert_same(*({i: np.asarray(s[name]) for i, s in state.items()} for state in states))


def gradients(parameters_of_library):
    return {name: p.grad.numpy() for name, p in parameters_of_library if p.grad is not None}


def as_library(networks, flat, names):
    """Pieces of a flat vector, in the shapes and under the names of the library's parameters."""
    pieces, begin = {}, 0
    linears = [linear for network in networks for linear in network.linears]
    for linear in linears:
        for parameter in (linear.weight, linear.bias):
            piece = flat[begin : begin + parameter.numel()]
            pieces[names[parameter]] = piece.reshape(tuple(parameter.shape)[::-1]).T.copy()
            begin += parameter.numel()
    assert begin == len(flat)
    return pieces


# --- deep Q-learning -----------------------------------------------------------------------------

Q_NAMES = ("dqn", "double_dqn", "deep_qlearning")


def fill_replay(model, place, seed):
    """A ring of made-up transitions, of which some end episodes, by a time limit or not."""
    rng, buffer = np.random.default_rng(seed), model.replay_buffer
    fill(buffer.observations, rng, model.observation_space)
    fill(buffer.next_observations, rng, model.observation_space)
    buffer.actions[:] = rng.integers(N_ACTIONS, size=buffer.actions.shape)
    buffer.rewards[:] = rng.normal(scale=2, size=buffer.rewards.shape)
    buffer.dones[:] = rng.random(buffer.dones.shape) < 0.3
    buffer.timeouts[:] = buffer.dones * (rng.random(buffer.dones.shape) < 0.5)
    buffer.pos, buffer.full = place


def train_q_agents(name, observations, place, n_updates, n_envs=2, **kwargs):
    """Both engines after so many updates, the compiled one with its last gradient."""
    models = []
    for engine in ("compiled", "library"):
        model = make(name, engine, observations, n_envs, buffer_size=30, **kwargs)
        model._setup_learn(1)
        fill_replay(model, place, seed=1)
        for parameter in model.q_net_target.parameters():
            parameter.data = parameter.data + 0.1
        models.append(model)
    ours, theirs = models
    names = {parameter: name for name, parameter in ours.q_net.named_parameters()}
    rng = np.random.default_rng()
    rng.bit_generator.state = ours.rng.bit_generator.state
    with ours._learning_compiled():
        ours.train(n_updates, ours.batch_size)
        held = ours._shared_training().held
        slopes = as_library(ours._shared_training().networks, held.gradient, names)
    with pytest.MonkeyPatch.context() as patch:
        draw_as_compiled(patch, theirs, rng)
        theirs.train(n_updates, theirs.batch_size)
    return ours, theirs, slopes


@given(
    name=st.sampled_from(Q_NAMES),
    observations=st.sampled_from([NUMBERS, VECTORS, DOUBLES]),
    net_arch=widths,
    function=st.sampled_from(sorted(FUNCTIONS)),
    batch_size=st.integers(1, 40),
    place=st.sampled_from([(9, False), (9, True), (0, True)]),
    n_steps=st.sampled_from([1, 3]),
)
@settings(max_examples=12)
@example("dqn", NUMBERS, [], "tanh", 5, (9, False), 4)
@example("dqn", VECTORS, [64, 64], "relu", 32, (9, True), 1)
@example("double_dqn", NUMBERS, [70, 1, 3], "identity", 32, (0, True), 3)
def test_q_gradient(name, observations, net_arch, function, batch_size, place, n_steps):
    ours, theirs, slopes = train_q_agents(
        name,
        observations,
        place,
        1,
        batch_size=batch_size,
        n_steps=n_steps,
        max_grad_norm=1e9,
        policy_kwargs={"net_arch": net_arch, "activation_fn": FUNCTIONS[function]},
    )
    assert_same(slopes, gradients(theirs.q_net.named_parameters()))
    losses = [model.logger.name_to_value["train/loss"] for model in (ours, theirs)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


# --- policy gradients ----------------------------------------------------------------------------


def fill_rollout(model, seed):
    """A made-up rollout, whose probabilities are a little off for PPO; and how it ends."""
    rng, buffer = np.random.default_rng(seed), model.rollout_buffer
    buffer.reset()
    fill(buffer.observations, rng, model.observation_space)
    buffer.actions[:] = rng.integers(N_ACTIONS, size=buffer.actions.shape)
    buffer.rewards[:] = rng.normal(scale=2, size=buffer.rewards.shape)
    buffer.episode_starts[:] = rng.random(buffer.rewards.shape) < 0.2
    buffer.values[:] = rng.normal(size=buffer.rewards.shape)
    with th.no_grad():
        observations = th.as_tensor(buffer.observations).flatten(0, 1)
        actions = th.as_tensor(buffer.actions).flatten().long()
        log_probs = model.policy.evaluate_actions(observations, actions)[1].numpy()
    noise = rng.normal(scale=0.3 * hasattr(model, "clip_range"), size=buffer.rewards.shape)
    buffer.log_probs[:] = np.minimum(log_probs.reshape(noise.shape) + noise, 0)
    buffer.full = True
    shape = model.n_envs
    return rng.normal(size=shape).astype(np.float32), (rng.random(shape) < 0.5).astype(np.float32)


def train_policy_agents(name, observations, n_envs=2, seeds=(1,), **kwargs):
    """Both engines after a training on each rollout, the compiled one with its last gradient."""
    ours, theirs = (
        make(name, engine, observations, n_envs, device="cpu", **kwargs)
        for engine in ("compiled", "library")
    )
    names = {parameter: name for name, parameter in ours.policy.named_parameters()}
    rng = np.random.default_rng()
    rng.bit_generator.state = ours.rng.bit_generator.state
    for model in (ours, theirs):
        model._setup_learn(1)
    for seed in seeds:
        for model in (ours, theirs):
            last_values, dones = fill_rollout(model, seed)
        with ours._learning_compiled():
            held = ours._shared_training().held
            held.last_values[:], held.starts[:] = last_values, dones
            estimate_advantages(ours._shared_training().learner, 0.0, 0.0)
            ours.train()
            slopes = as_library(ours._shared_training().networks, held.gradient, names)
        with pytest.MonkeyPatch.context() as patch:
            draw_as_compiled(patch, theirs, rng)
            last = th.as_tensor(last_values)
            theirs.rollout_buffer.compute_returns_and_advantage(last, dones)
            theirs.train()
    return ours, theirs, slopes


def assert_same_logs(ours, theirs):
    logs = [model.logger.name_to_value for model in (ours, theirs)]
    known = {name for name in logs[1] if name.startswith("train/")}
    assert {name for name in logs[0] if name.startswith("train/")} == known
    for name in known:
        assert logs[0][name] == pytest.approx(logs[1][name], rel=1e-4, abs=1e-6), name


@given(
    name=st.sampled_from(["ppo", "a2c"]),
    observations=st.sampled_from([NUMBERS, VECTORS]),
    pi=widths,
    vf=widths,
    function=st.sampled_from(sorted(FUNCTIONS)),
    normalize=st.booleans(),
)
@settings(max_examples=12)
@example("ppo", NUMBERS, [], [], "tanh", True)
@example("a2c", VECTORS, [64, 64], [64, 64], "tanh", False)
@example("ppo", VECTORS, [70, 1], [3], "relu", True)
def test_policy_gradient(name, observations, pi, vf, function, normalize):
    own = {"n_epochs": 1, "batch_size": 24} if name == "ppo" else {}
    ours, theirs, slopes = train_policy_agents(
        name,
        observations,
        n_steps=12,
        ent_coef=0.1,
        max_grad_norm=1e9,
        normalize_advantage=normalize,
        policy_kwargs={
            "net_arch": {"pi": pi, "vf": vf},
            "activation_fn": FUNCTIONS[function],
            "ortho_init": False,
        },
        **own,
    )
    assert_same(slopes, gradients(theirs.policy.named_parameters()))
    assert_same_logs(ours, theirs)


# --- many updates in a row ------------------------------------------------------------------------


def after_100_updates(name, observations, **settings):
    """Both engines after the same minibatches."""
    if name in Q_NAMES:
        settings = {"learning_rate": 1e-3, "gamma": 0.9, "n_steps": 3, **settings}
        return train_q_agents(name, observations, (9, True), 100, **settings)[:2]
    if name == "a2c":
        settings = {"n_steps": 5, "seeds": range(100), **settings}
        return train_policy_agents(name, observations, **settings)[:2]
    settings = {"n_steps": 20, "batch_size": 10, "n_epochs": 25, **settings}
    return train_policy_agents(name, observations, **settings)[:2]


def optimizer(kind, **kwargs):
    return {"policy_kwargs": {"optimizer_class": kind, "optimizer_kwargs": kwargs}}


def layers(function):
    return {"policy_kwargs": {"net_arch": [24, 17], "activation_fn": FUNCTIONS[function]}}


# Other settings are tried where whole trainings stand beside the library's: test_network_loops.py.
MANY = {
    "dqn": ("dqn", NUMBERS, {**layers("relu"), "max_grad_norm": 1.0}),
    "double_dqn": ("double_dqn", VECTORS, layers("tanh")),
    "deep_qlearning": ("deep_qlearning", NUMBERS, layers("identity")),
    "ppo": ("ppo", VECTORS, {}),
    "ppo, remainders": ("ppo", NUMBERS, {"batch_size": 7}),
    "ppo, nothing clipped": ("ppo", VECTORS, {"clip_range": 1e9, "max_grad_norm": 1e9}),
    "ppo, a small norm": ("ppo", NUMBERS, {"max_grad_norm": 0.01, "clip_range_vf": 0.2}),
    "ppo, early stop": ("ppo", VECTORS, {"target_kl": 0.1, "learning_rate": 1e-2}),
    "ppo, AdamW": ("ppo", NUMBERS, optimizer(th.optim.AdamW, weight_decay=3.0)),
    "a2c, RMSprop": ("a2c", NUMBERS, optimizer(th.optim.RMSprop, eps=1e-5)),
    "a2c, as TensorFlow": ("a2c", VECTORS, optimizer(RMSpropTFLike, eps=1e-5, weight_decay=0.1)),
}


@pytest.mark.parametrize("case", MANY)
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_weights_after_100_updates(case):
    name, observations, settings = MANY[case]
    ours, theirs = after_100_updates(name, observations, **settings)
    assert_same(parameters(ours), parameters(theirs))
    assert_same_optimizers(ours, theirs)
    assert ours._n_updates == theirs._n_updates > 1
    assert (theirs._n_updates < 25) == (case == "ppo, early stop")
    if name not in Q_NAMES:
        assert_same_logs(ours, theirs)


# --- returns over several steps ------------------------------------------------------------------


PLACES = [(9, False), (9, True), (0, True), (29, True)]


@pytest.mark.parametrize(
    ("n_steps", "place"), [(2, PLACES[3]), *((5, place) for place in PLACES), (40, PLACES[1])]
)
def test_returns_over_several_steps(n_steps, place):
    """Made-up values of next states would hide what a minibatch holds: it is looked at itself."""
    model = make("dqn", "compiled", NUMBERS, buffer_size=60, n_steps=n_steps, batch_size=400)
    model._setup_learn(1)
    assert isinstance(model.replay_buffer, NStepReplayBuffer)
    fill_replay(model, place, seed=3)
    rng = np.random.default_rng()
    rng.bit_generator.state = model.rng.bit_generator.state
    with model._learning_compiled():
        held = model._shared_training().held
        # Where all values are zero, rewards stay what they were.
        held.target[:] = 0
        model.train(1, 400)
        batch = held.batch
        ours = [
            array.copy() for array in (batch.rewards, batch.discounts, batch.next_states.indices)
        ]
    with pytest.MonkeyPatch.context() as patch:
        draw_as_compiled(patch, model, rng)
        samples = model.replay_buffer.sample(400)
    discounts = (samples.discounts * (1 - samples.dones)).numpy().ravel()
    np.testing.assert_allclose(ours[0], samples.rewards.numpy().ravel(), rtol=0, atol=1e-5)
    np.testing.assert_allclose(ours[1], discounts, rtol=1e-6)
    np.testing.assert_array_equal(ours[2], samples.next_observations.numpy().ravel())

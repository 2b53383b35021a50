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


def make(name, engine, observations, policy_kwargs=None, **kwargs):
    env = make_vec_env(Nowhere, 2, env_kwargs={"observations": observations})
    return load_algorithm(name)(
        "MlpPolicy", env, seed=0, engine=engine, policy_kwargs=policy_kwargs, **kwargs
    )


def fill(array, rng, observations):
    """Make up observations."""
    if isinstance(observations, spaces.Discrete):
        array[:] = rng.integers(observations.n, size=array.shape)
    else:
        array[:] = rng.normal(size=array.shape)


def assert_same(ours, theirs):
    """Two sets of arrays agree."""
    assert ours.keys() == theirs.keys()
    apart = sum(np.sum((ours[name] - value) ** 2) for name, value in theirs.items())
    whole = sum(np.sum(value**2) for value in theirs.values())
    assert apart <= (TOLERANCE**2) * whole, np.sqrt(apart / whole)


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


def train_q_agents(name, observations, place, **kwargs):
    """Both engines after an update, the compiled one with its gradient."""
    models = []
    for engine in ("compiled", "library"):
        model = make(name, engine, observations, buffer_size=30, **kwargs)
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
        ours.train(1, ours.batch_size)
        held = ours._shared_training().held
        slopes = as_library(ours._shared_training().networks, held.gradient, names)
    with pytest.MonkeyPatch.context() as patch:
        draw_as_compiled(patch, theirs, rng)
        theirs.train(1, theirs.batch_size)
    return ours, theirs, slopes


@given(
    name=st.sampled_from(["dqn", "double_dqn", "deep_qlearning"]),
    observations=st.sampled_from([NUMBERS, VECTORS, DOUBLES]),
    net_arch=widths,
    function=st.sampled_from(sorted(FUNCTIONS)),
    batch_size=st.integers(1, 40),
    place=st.sampled_from([(9, False), (9, True), (0, True)]),
    n_steps=st.sampled_from([1, 3]),
)
@settings(max_examples=8)
@example("dqn", NUMBERS, [], "tanh", 5, (9, False), 4)
@example("dqn", VECTORS, [64, 64], "relu", 32, (9, True), 1)
@example("double_dqn", NUMBERS, [70, 1, 3], "identity", 32, (0, True), 3)
def test_q_gradient(name, observations, net_arch, function, batch_size, place, n_steps):
    ours, theirs, slopes = train_q_agents(
        name,
        observations,
        place,
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


def train_policy_agents(name, observations, **kwargs):
    """Both engines after a training on a rollout, the compiled one with its last gradient."""
    ours, theirs = (
        make(name, engine, observations, device="cpu", **kwargs)
        for engine in ("compiled", "library")
    )
    names = {parameter: name for name, parameter in ours.policy.named_parameters()}
    rng = np.random.default_rng()
    rng.bit_generator.state = ours.rng.bit_generator.state
    for model in (ours, theirs):
        model._setup_learn(1)
        last_values, dones = fill_rollout(model, seed=1)
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
@settings(max_examples=8)
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

"""Step by step what the library does, made to draw the numbers that compiled code draws."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.utils import LinearSchedule
from torch.distributions import Categorical

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.common.callbacks import BlockCallback, Horizon
from envs.wrappers import OneHotObservation

# What rounding comes to after a few hundred steps of training.
TOLERANCE = 1e-4


class Lists(KVWriter):
    """Keeps what is logged, but for times."""

    def __init__(self):
        self.dumps = []

    def write(self, key_values, key_excluded, step=0):
        times = ("time/fps", "time/time_elapsed")
        self.dumps.append((step, {k: v for k, v in key_values.items() if k not in times}))

    def close(self):
        pass


class Plain(BaseCallback):
    """Something that has to be asked after each step."""

    def _on_step(self):
        return True


class Diary(BlockCallback):
    """Writes down what can be seen after each step."""

    def __init__(self):
        super().__init__()
        self.steps = []

    def horizon(self):
        return Horizon(calls=1)

    def _on_step(self):
        model, told = self.model, self.locals
        buffer = getattr(model, "replay_buffer", None)
        self.steps.append(
            {
                "n": (self.n_calls, self.num_timesteps, model._n_updates, model._episode_num),
                "told": [told[k].tolist() for k in ("actions", "rewards", "dones", "new_obs")],
                "infos": [self._info(info) for info in told["infos"]],
                "last_obs": model._last_obs.tolist(),
                "starts": np.array(model._last_episode_starts).tolist() * (buffer is None),
                "episodes": [(info["r"], info["l"]) for info in model.ep_info_buffer],
                "remaining": model._current_progress_remaining,
                "epsilon": getattr(model, "exploration_rate", 0),
                "calls": getattr(model, "_n_calls", 0),
                "ring": buffer and (buffer.pos, buffer.full),
                "rate": model.policy.optimizer.param_groups[0]["lr"],
                "weights": [p.detach().numpy().copy() for p in model.policy.parameters()],
            }
        )
        return True

    def _info(self, info):
        end = info.get("terminal_observation")
        episode = info.get("episode")
        return (
            info["TimeLimit.truncated"],
            None if end is None else np.array(end).tolist(),
            episode and (episode["r"], episode["l"]),
        )


class Rollouts(BlockCallback):
    """Writes down what rollouts begin and end with."""

    def __init__(self):
        super().__init__()
        self.found = []

    def look(self, *more):
        model = self.model
        weights = th.cat([p.detach().flatten() for p in model.policy.parameters()])
        self.found.append((self.n_calls, model._n_updates, float(weights.sum()), *more))

    def _on_rollout_start(self):
        self.look()

    def _on_rollout_end(self):
        if hasattr(self.model, "replay_buffer"):
            self.look(self.model.replay_buffer.pos)
            return
        buffer = self.model.rollout_buffer
        assert buffer.full
        arrays = [np.array(getattr(buffer, name)) for name in ROLLOUT]
        self.look(buffer.pos, *arrays)

    def _on_step(self):
        return True


ROLLOUT = ("observations", "actions", "rewards", "episode_starts", "values", "log_probs")
ROLLOUT += ("advantages", "returns")
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def draw_as_compiled(patch, model):
    """Let the library's agent draw from its generator for compiled code, in the same order."""
    rng, drawn = model.rng, []

    def randint(low, high=None, size=None):
        if not drawn:
            limits = model.replay_buffer.size(), model.n_envs
            drawn.extend((rng.random((model.batch_size, 2)) * limits).astype(int).T)
        return drawn.pop(0)

    def permutation(n):
        numbers, n_envs = np.arange(n), model.n_envs
        for i in range(n - 1, 0, -1):
            j = int(rng.random() * (i + 1))
            numbers[[i, j]] = numbers[[j, i]]
        return numbers % n_envs * model.n_steps + numbers // n_envs

    def sample(distribution):
        cumulative = distribution.probs.double().cumsum(dim=1).numpy()
        uniform = rng.random(len(cumulative))[:, np.newaxis]
        return th.as_tensor((cumulative[:, :-1] <= uniform).sum(axis=1))

    patch.setattr(np.random, "rand", rng.random)
    patch.setattr(np.random, "randint", randint)
    patch.setattr(np.random, "permutation", permutation)
    patch.setattr(Categorical, "sample", sample)
    n_actions = int(model.action_space.n)
    patch.setattr(model.action_space, "sample", lambda: int(rng.random() * n_actions))


def train(mode, name, make_env, n_envs, steps, log_interval, **kwargs):
    """Train in the library's loop, the same with compiled parts, or in the compiled one."""
    model = load_algorithm(name)(
        "MlpPolicy",
        make_vec_env(make_env, n_envs, seed=3),
        seed=5,
        engine="library" if mode == "library" else "compiled",
        learning_rate=LinearSchedule(1e-2, 1e-3, 0.8),
        policy_kwargs={"net_arch": [16]},
        **kwargs,
    )
    lists, diary, rollouts = Lists(), Diary(), Rollouts()
    model.set_logger(Logger(None, [lists]))
    asked = {"compiled": [diary], "parts": [diary, Plain(), rollouts]}
    callback = CallbackList(asked.get(mode, [diary, rollouts]))
    with pytest.MonkeyPatch.context() as patch:
        if mode == "library":
            draw_as_compiled(patch, model)
        model.learn(steps, callback=callback, log_interval=log_interval)
    assert (model.engine_in_use == "compiled") == (mode in {"compiled", "rollouts"})
    return model, diary, lists.dumps, rollouts.found


def by_library(name, make_env, n_envs, steps, log_interval, **kwargs):
    """What the library does, once for all that is held against it."""
    key = name, make_env, n_envs, steps, log_interval, repr(kwargs)
    if key not in _by_library:
        _by_library[key] = train("library", name, make_env, n_envs, steps, log_interval, **kwargs)
    return _by_library[key]


_by_library = {}


def unflattened(model, name):
    """An array of the rollout buffer, as it was before the library took it apart."""
    array, (n_steps, n_envs) = (
        getattr(model.rollout_buffer, name),
        model.rollout_buffer.rewards.shape,
    )
    if len(array) == n_steps * n_envs and n_envs > 1:
        return array.reshape(n_envs, n_steps, -1).swapaxes(0, 1)
    return array.reshape(n_steps, n_envs, -1)


def assert_close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=TOLERANCE, atol=TOLERANCE)


def assert_same_steps(ours, theirs):
    assert len(ours.steps) == len(theirs.steps)
    for i, (our, their) in enumerate(zip(ours.steps, theirs.steps, strict=True)):
        for name, value in their.items():
            if name == "weights":
                for pair in zip(our[name], value, strict=True):
                    assert_close(*pair)
            elif name in {"rate", "remaining", "epsilon"}:
                assert our[name] == pytest.approx(value, rel=1e-12), (i, name)
            else:
                assert our[name] == value, (i, name)


def assert_same_rollouts(ours, theirs):
    assert len(ours) == len(theirs) > 5
    for our, their in zip(ours, theirs, strict=True):
        assert our[:2] == their[:2]
        for pair in zip(our[2:], their[2:], strict=True):
            assert_close(*pair)


def assert_same_logs(ours, theirs):
    assert [step for step, _ in ours] == [step for step, _ in theirs]
    for i, ((_, our), (_, their)) in enumerate(zip(ours, theirs, strict=True)):
        assert our.keys() == their.keys(), i
        for name, value in their.items():
            assert our[name] == pytest.approx(value, rel=1e-3, abs=1e-4), (i, name)


frozen_lake = partial(gym.make, "FrozenLake-v1", max_episode_steps=6)
vectors = lambda: OneHotObservation(frozen_lake())  # noqa: E731
cart_pole = partial(gym.make, "CartPole-v1", max_episode_steps=9)

Q = {"learning_starts": 20, "buffer_size": 120, "batch_size": 8, "target_update_interval": 10}
Q_CASES = {
    "dqn": ("dqn", frozen_lake, 1, {}),
    "two environments": ("dqn", frozen_lake, 2, {"gradient_steps": -1, "tau": 0.5}),
    "episodes": ("dqn", cart_pole, 1, {"train_freq": (2, "episode"), "gradient_steps": -1}),
    "several steps": ("dqn", vectors, 2, {"n_steps": 3, "train_freq": 3, "gradient_steps": 2}),
    "double": ("double_dqn", cart_pole, 2, {"tau": 0.5}),
    "deep": ("deep_qlearning", frozen_lake, 1, {"exploration_fraction": 0.5}),
    "no time limits": (
        "dqn",
        frozen_lake,
        1,
        {"replay_buffer_kwargs": {"handle_timeout_termination": False}, "gamma": 0.9},
    ),
    "greedy at once": ("dqn", vectors, 1, {"exploration_fraction": 0.0}),
}


@pytest.mark.parametrize("mode", ["parts", "compiled", "rollouts"])
@pytest.mark.parametrize("case", Q_CASES)
def test_deep_q_learning_does_what_the_library_does(case, mode):
    name, make_env, n_envs, kwargs = Q_CASES[case]
    arguments = name, make_env, n_envs, 303, 3
    ours, diary, logs, rollouts = train(mode, *arguments, **Q, **kwargs)
    theirs, their_diary, their_logs, their_rollouts = by_library(*arguments, **Q, **kwargs)
    assert ours.num_timesteps == theirs.num_timesteps >= 303
    assert_same_steps(diary, their_diary)
    if mode != "compiled":
        assert_same_rollouts(rollouts, their_rollouts)
    assert len(their_logs) > 5
    assert_same_logs(logs, their_logs)
    for array in REPLAY:
        expected = getattr(theirs.replay_buffer, array)
        np.testing.assert_array_equal(getattr(ours.replay_buffer, array), expected)
    assert theirs.replay_buffer.timeouts.any() == (case != "no time limits")
    for network in ("q_net", "q_net_target"):
        expected = getattr(theirs, network).state_dict()
        for key, value in getattr(ours, network).state_dict().items():
            assert_close(value, expected[key])
    assert (ours._n_updates, ours._n_calls) == (theirs._n_updates, theirs._n_calls)
    assert ours.exploration_rate == pytest.approx(theirs.exploration_rate, rel=1e-12)


PPO = {"n_steps": 24, "batch_size": 16, "n_epochs": 2}
POLICY_CASES = {
    "ppo": ("ppo", frozen_lake, 2, {**PPO, "clip_range": LinearSchedule(0.3, 0.1, 1.0)}),
    "ppo on vectors": ("ppo", vectors, 1, {**PPO, "batch_size": 8, "clip_range_vf": 0.1}),
    "ppo on cart pole": ("ppo", cart_pole, 2, {**PPO, "target_kl": 0.003}),
    "a2c": ("a2c", frozen_lake, 2, {"gamma": 0.9, "gae_lambda": 0.8}),
    "a2c on cart pole": ("a2c", cart_pole, 1, {"normalize_advantage": True, "ent_coef": 0.1}),
}


@pytest.mark.parametrize(
    ("mode", "log_interval"), [("parts", 3), ("rollouts", 3), ("compiled", 3), ("compiled", 1)]
)
@pytest.mark.parametrize("case", POLICY_CASES)
def test_policy_gradients_do_what_the_library_does(case, mode, log_interval):
    name, make_env, n_envs, kwargs = POLICY_CASES[case]
    arguments = name, make_env, n_envs, 250, log_interval
    ours, diary, logs, rollouts = train(mode, *arguments, **kwargs)
    theirs, their_diary, their_logs, their_rollouts = by_library(*arguments, **kwargs)
    assert ours.num_timesteps == theirs.num_timesteps >= 250
    assert_same_steps(diary, their_diary)
    assert_same_logs(logs, their_logs)
    for array in ROLLOUT:
        assert_close(unflattened(ours, array), unflattened(theirs, array))
    assert ours.rollout_buffer.full
    assert ours._n_updates == theirs._n_updates
    assert ours._last_episode_starts.tolist() == theirs._last_episode_starts.tolist()
    if mode != "compiled":
        assert_same_rollouts(rollouts, their_rollouts)

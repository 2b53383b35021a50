"""Networks trained in three loops: the library's, the same with compiled parts, the compiled one.

The library, made to draw the numbers that compiled code draws, agrees up to rounding, also in every
weight after every step. The others end in the same bits, wherever blocks of steps end.
"""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.common.callbacks import BlockCallback, Horizon
from envs.wrappers import OneHotObservation
from tests.agents.networks.as_compiled import draw_as_compiled

TOLERANCE = 1e-4  # what rounding comes to after a few hundred steps
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
ROLLOUT = ("observations", "actions", "rewards", "episode_starts", "values", "log_probs")
ROLLOUT += ("advantages", "returns")


def lake(steps=6):
    return gym.make("FrozenLake-v1", max_episode_steps=steps)


def vectors(steps=6):
    return OneHotObservation(lake(steps))


def pole(steps=9):
    return gym.make("CartPole-v1", max_episode_steps=steps)


class Plain(BaseCallback):
    """Has to be asked after each step, so that the library's loop runs."""

    def _on_step(self):
        return True


class Every(BlockCallback):
    """Does something on every so many calls, and lets blocks be no longer than that."""

    def __init__(self, calls, do=lambda model: None):
        super().__init__()
        self.calls, self.do = calls, do

    def horizon(self):
        return Horizon(calls=self.calls - self.n_calls % self.calls)

    def _on_step(self):
        return self.n_calls % self.calls != 0 or self.do(self.model) is not False


def networks(name, env, n_envs, engine="compiled", rate=(1e-2, 1e-3, 0.8), width=(16,), **kwargs):
    wrap = kwargs.pop("wrap", lambda env: env)
    return load_algorithm(name)(
        "MlpPolicy",
        wrap(make_vec_env(env, n_envs, seed=3)),
        seed=5,
        engine=engine,
        learning_rate=LinearSchedule(*rate),
        policy_kwargs={"net_arch": list(width), **kwargs.pop("policy_kwargs", {})},
        **kwargs,
    )


# --- against the library -------------------------------------------------------------------------


class Lists(KVWriter):
    """Keeps what is logged, but for times."""

    def __init__(self):
        self.dumps = []

    def write(self, key_values, key_excluded, step=0):
        times = ("time/fps", "time/time_elapsed")
        kept = {k: v for k, v in sorted(key_values.items()) if k not in times}
        self.dumps.append((step, kept))

    def close(self):
        pass


class Diary(BlockCallback):
    """Writes down what can be seen after each step: as it is, and up to rounding."""

    def __init__(self):
        super().__init__()
        self.exact, self.close = [], []

    def horizon(self):
        return Horizon(calls=1)

    def _on_step(self):
        model, told = self.model, self.locals
        buffer = getattr(model, "replay_buffer", None)
        self.exact.append(
            {
                "n": (self.n_calls, self.num_timesteps, model._n_updates, model._episode_num),
                "told": [told[k].tolist() for k in ("actions", "rewards", "dones", "new_obs")],
                "infos": [self._info(info) for info in told["infos"]],
                "last_obs": model._last_obs.tolist(),
                "starts": np.array(model._last_episode_starts).tolist() * (buffer is None),
                "episodes": [(info["r"], info["l"]) for info in model.ep_info_buffer],
                "calls": getattr(model, "_n_calls", 0),
                "ring": buffer and (buffer.pos, buffer.full),
            }
        )
        rates = model._current_progress_remaining, getattr(model, "exploration_rate", 0)
        weights = [p.detach().numpy().ravel() for p in model.policy.parameters()]
        learning_rate = model.policy.optimizer.param_groups[0]["lr"]
        self.close.append(np.concatenate([[*rates, learning_rate], *weights]))
        return True

    def _info(self, info):
        end, episode = info.get("terminal_observation"), info.get("episode")
        ended = None if end is None else np.array(end).tolist()
        return info["TimeLimit.truncated"], ended, episode and (episode["r"], episode["l"])


class Rollouts(BlockCallback):
    """Writes down what rollouts begin and end with."""

    def __init__(self):
        super().__init__()
        self.exact, self.close = [], []

    def _look(self, *arrays):
        weights = [p.detach().numpy().ravel() for p in self.model.policy.parameters()]
        self.exact.append((self.n_calls, self.model._n_updates))
        self.close.append(np.concatenate([*weights, *map(np.ravel, arrays)]))

    def _on_rollout_start(self):
        self._look()

    def _on_rollout_end(self):
        if hasattr(self.model, "replay_buffer"):
            self._look([self.model.replay_buffer.pos])
        else:
            assert self.model.rollout_buffer.full
            self._look(*(getattr(self.model.rollout_buffer, name) for name in ROLLOUT))

    def _on_step(self):
        return True


def unflattened(buffer, name):
    """An array of the rollout buffer, as it was before the library took it apart."""
    array, (n_steps, n_envs) = getattr(buffer, name), buffer.rewards.shape
    if len(array) == n_steps * n_envs and n_envs > 1:
        return array.reshape(n_envs, n_steps, -1).swapaxes(0, 1)
    return array.reshape(n_steps, n_envs, -1)


def followed(mode, case):
    """What can be seen of a training, in a list that is exact and in one up to rounding."""
    name, env, n_envs, log_interval, settings = CASES[case]
    model = networks(name, env, n_envs, "library" if mode == "library" else "compiled", **settings)
    lists, diary, rollouts = Lists(), Diary(), Rollouts()
    model.set_logger(Logger(None, [lists]))
    with pytest.MonkeyPatch.context() as patch:
        if mode == "library":
            draw_as_compiled(patch, model, model.rng)
        asked = [diary] if mode == "blocks" else [diary, rollouts]
        model.learn(303, callback=asked, log_interval=log_interval)
    expected = "library" if mode == "library" else "compiled"
    assert model.engine_in_use.partition(" but")[0].partition(":")[0] == expected
    exact = [diary.exact, [(step, list(record)) for step, record in lists.dumps]]
    logged = [value for _, record in lists.dumps for value in record.values()]
    moments = model.policy.optimizer.state_dict()["state"]
    kept = [np.asarray(moments[i][name]) for i in sorted(moments) for name in sorted(moments[i])]
    close = [*diary.close, *(value.numpy() for value in model.policy.state_dict().values()), *kept]
    if name.startswith(("dqn", "do", "de")):
        exact += [getattr(model.replay_buffer, array).tolist() for array in REPLAY]
        assert model.replay_buffer.timeouts.any() == ("replay_buffer_kwargs" not in settings)
    else:
        close += [unflattened(model.rollout_buffer, array) for array in ROLLOUT]
    assert model.num_timesteps >= 303
    return (exact, close, logged), (rollouts.exact, rollouts.close)


Q = {"learning_starts": 20, "buffer_size": 120, "batch_size": 8, "target_update_interval": 10}
PPO = {"n_steps": 24, "batch_size": 16, "n_epochs": 2}
UNLIMITED = {"replay_buffer_kwargs": {"handle_timeout_termination": False}, "gamma": 0.9}
IDENTITY = {"activation_fn": nn.Identity}


def policy(optimizer=None, net_arch=(16,), activation_fn=None, **kwargs):
    """Settings of networks and of what moves their weights."""
    found = {"net_arch": net_arch} | ({"activation_fn": activation_fn} if activation_fn else {})
    if optimizer is not None:
        found |= {"optimizer_class": optimizer, "optimizer_kwargs": kwargs}
    return {"policy_kwargs": found}


class Matrices(gym.Env):
    """Observations of two dimensions in double precision, and no model."""

    observation_space = spaces.Box(-1, 1, (2, 3), np.float64)
    action_space = spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, (2, 3)), {}

    def step(self, action):
        obs, _ = self.reset()
        return obs, float(obs[0, action]), bool(obs[1, 0] < -0.8), bool(obs[1, 1] < -0.8), {}


def normalised(env, **kwargs):
    """Statistics as they might be after a while."""
    env = VecNormalize(env, clip_obs=1.5, clip_reward=0.8, **kwargs)
    if env.norm_obs:
        rng = np.random.default_rng(4)
        env.obs_rms.mean, env.obs_rms.var = rng.normal(size=(2, 3)), rng.uniform(0.3, 2, (2, 3))
    env.ret_rms.var = 7.0
    return env


CASES = {  # agent, environment, how many, episodes between two records, settings
    "dqn": ("dqn", lake, 1, 3, Q),
    "two environments": ("dqn", lake, 2, 3, {**Q, "gradient_steps": -1, "tau": 0.5}),
    "episodes": ("dqn", pole, 1, 3, {**Q, "train_freq": (2, "episode"), "gradient_steps": -1}),
    "steps": ("dqn", vectors, 2, 3, {**Q, "n_steps": 3, "train_freq": 3, "gradient_steps": 2}),
    "double": ("double_dqn", pole, 2, 3, {**Q, "tau": 0.5}),
    "deep": ("deep_qlearning", lake, 1, 3, {**Q, "exploration_fraction": 0.5}),
    "no time limits": ("dqn", lake, 1, 3, {**Q, **UNLIMITED}),
    "greedy at once": ("dqn", vectors, 1, 3, {**Q, "exploration_fraction": 0.0}),
    "narrow": ("double_dqn", lake, 1, 3, {**Q, **policy(net_arch=[70, 1, 3], **IDENTITY)}),
    "matrices": ("dqn", Matrices, 2, 3, {**Q, "n_steps": 3, "max_grad_norm": 0.1}),
    "ppo, normalised": ("ppo", Matrices, 2, 3, {**PPO, "wrap": normalised}),
    "ppo, clipped by a function": (
        "ppo", lake, 1, 3, {**PPO, "clip_range": lambda remaining: 0.05 + 0.2 * remaining}),
    "normalised rewards": (
        "deep_qlearning", Matrices, 1, 3, {**Q, "wrap": partial(normalised, norm_obs=False)}),
    "ppo": ("ppo", lake, 2, 3, {**PPO, "clip_range": LinearSchedule(0.3, 0.1, 1.0)}),
    "ppo on vectors": ("ppo", vectors, 1, 1, {**PPO, "batch_size": 8, "clip_range_vf": 0.1}),
    "ppo on poles": ("ppo", pole, 2, 3, {**PPO, "target_kl": 0.003}),
    "ppo, a remainder of one": ("ppo", vectors, 2, 3, {**PPO, "n_steps": 25, "batch_size": 7}),
    "ppo by Adam": (
        "ppo", lake, 1, 3,
        {**PPO, **policy(th.optim.Adam, betas=(0.5, 0.9), eps=1e-3, weight_decay=0.1)}),
    "ppo by AdamW": (
        "ppo", Matrices, 1, 3,
        {**PPO, "normalize_advantage": False, **policy(th.optim.AdamW, weight_decay=3.0)}),
    "ppo, two networks": (
        "ppo", pole, 1, 3,
        {**PPO, "max_grad_norm": 0.01, "ent_coef": 0.1,
         **policy(net_arch={"pi": [70, 1], "vf": []}, activation_fn=nn.ReLU)}),
    "a2c": ("a2c", lake, 2, 1, {"gamma": 0.9, "gae_lambda": 0.8}),
    "a2c by RMSprop": (
        "a2c", pole, 1, 3,
        {"normalize_advantage": True, "ent_coef": 0.1, **policy(th.optim.RMSprop, eps=1e-5)}),
    "a2c with decay": (
        "a2c", pole, 1, 3, policy(RMSpropTFLike, eps=1e-5, weight_decay=0.1)),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
@pytest.mark.parametrize("case", CASES)
def test_compiled_training_does_what_the_library_does(case):
    library, at_rollouts = followed("library", case)
    for mode in ("blocks", "rollouts"):
        (exact, close, logged), found = followed(mode, case)
        assert exact == library[0]
        for ours, theirs in zip(close, library[1], strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=TOLERANCE, atol=TOLERANCE)
        np.testing.assert_allclose(logged, library[2], rtol=1e-3, atol=1e-4)
    assert len(library[0][1]) > (5 if CASES[case][4].get("learning_starts") else 1)
    assert found[0] == at_rollouts[0]
    for ours, theirs in zip(found[1], at_rollouts[1], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=TOLERANCE, atol=TOLERANCE)


# --- compiled parts against the compiled loop ----------------------------------------------------

ENVS = {
    "lake": partial(lake, 12),
    "vectors": partial(vectors, 12),
    "pole": partial(pole, 30),
    "Warehouse": partial(gym.make, "Warehouse-v0", max_episode_steps=20),
}
Q_OFTEN = {**Q, "learning_starts": 50, "buffer_size": 150, "batch_size": 16}
KINDS = {
    "dqn": ("dqn", 1, {**Q_OFTEN, "train_freq": 1, "tau": 0.5}),
    "dqn, two": ("dqn", 2, {**Q_OFTEN, "train_freq": 3, "gradient_steps": -1, "n_steps": 3}),
    "dqn, episodes": ("dqn", 1, {**Q_OFTEN, "train_freq": (1, "episode"), "gradient_steps": 5}),
    "double": ("double_dqn", 2, {**Q_OFTEN, "n_steps": 2}),
    "deep": ("deep_qlearning", 1, Q_OFTEN),
    "ppo": ("ppo", 1, {"n_steps": 64, "n_epochs": 3, "target_kl": 0.02}),
    "ppo, two": ("ppo", 2, {"n_steps": 50, "batch_size": 25, "clip_range_vf": 0.2}),
    "a2c": ("a2c", 2, {"normalize_advantage": True}),
}
MODES = ("parts", "compiled")


def make(env, kind, **kwargs):
    name, n_envs, settings = KINDS[kind]
    return networks(
        name, ENVS[env], n_envs, rate=(0.01, 0.001, 1.0), width=(24, 8), **{**settings, **kwargs}
    )


def learn(model, mode, steps, *callbacks, **kwargs):
    model.learn(steps, callback=[*callbacks, *[Plain()] * (mode == "parts")], **kwargs)
    expected = "compiled but for" if mode == "parts" else "compiled"
    assert model.engine_in_use.partition(" the")[0] == expected
    return model


def state(model):
    """All that training has changed."""
    found = {f"policy.{key}": value.numpy() for key, value in model.policy.state_dict().items()}
    optimizer = model.policy.optimizer.state_dict()
    for i, kept in optimizer["state"].items():
        found |= {f"optimizer.{i}.{key}": np.asarray(value) for key, value in kept.items()}
    buffer = model.replay_buffer if hasattr(model, "replay_buffer") else model.rollout_buffer
    if hasattr(model, "replay_buffer") or buffer.full:  # a rollout that is given up is nothing
        names = {name for name in (*REPLAY, *ROLLOUT) if hasattr(buffer, name)}
        found |= {name: getattr(buffer, name) for name in names}
    names = ("num_timesteps", "_n_updates", "_episode_num", "_last_obs", "_n_calls")
    names += ("exploration_rate", "_current_progress_remaining", "_last_episode_starts")
    found |= {name: np.asarray(getattr(model, name)) for name in names if hasattr(model, name)}
    found["rate"] = np.asarray(optimizer["param_groups"][0]["lr"])
    found["episodes"] = np.array([(info["r"], info["l"]) for info in model.ep_info_buffer])
    generators = [model.rng, *(env.unwrapped.np_random for env in model.env.envs)]
    found["draws"] = np.array([g.bit_generator.state["state"]["state"] % 2**62 for g in generators])
    bases = [env.unwrapped for env in model.env.envs]
    found["places"] = np.array([base.s if hasattr(base, "s") else base.state for base in bases])
    return found


def assert_same(ours, theirs):
    ours, theirs = state(ours), state(theirs)
    assert ours.keys() == theirs.keys()
    assert [name for name in ours if not np.array_equal(ours[name], theirs[name])] == []


LONGER = [("Warehouse", "dqn, two"), ("Warehouse", "ppo, two")]


@pytest.mark.parametrize(("env", "kind"), [*(("lake", kind) for kind in KINDS), *LONGER])
def test_both_end_in_the_same_bits_wherever_blocks_end(env, kind):
    parts = learn(make(env, kind), "parts", 500)
    assert parts._n_updates > 0
    assert len(parts.ep_info_buffer) > 5
    blocks = ((), (Every(1),), (Every(7), Every(30))) if env == "lake" else ((),)
    for callbacks in blocks:
        assert_same(learn(make(env, kind), "compiled", 500, *callbacks), parts)


@pytest.mark.parametrize(
    ("env", "kind"),
    [("vectors", "dqn, two"), *(("pole", kind) for kind in ("dqn, episodes", "ppo, two", "a2c"))],
)
def test_a_training_that_was_stopped_goes_on(env, kind):
    models = []
    for mode in MODES:
        stop = Every(123, lambda model: False)
        model = learn(make(env, kind), mode, 1000, stop)
        assert model.num_timesteps == 123 * model.n_envs
        models.append(learn(model, mode, 300, reset_num_timesteps=False))
    assert_same(*models)


# --- changes by hand -----------------------------------------------------------------------------


def load_another_optimizer_state(model):
    """As of an optimizer that has come far."""
    optimizer, rng = model.policy.optimizer, np.random.default_rng(8)
    state = optimizer.state_dict()
    for kept in state["state"].values():
        kept["step"] = kept["step"] + 1000
        for name in ("exp_avg", "exp_avg_sq"):
            noise = rng.random(tuple(kept[name].shape), np.float32)
            kept[name] = th.from_numpy(noise).square() / 100
    optimizer.load_state_dict(state)


def weigh(factor):
    def change(model):
        for parameter in model.policy.parameters():
            parameter.data = parameter.data * factor

    return change


def take(optimizer_class):
    def change(model):
        parameters = model.policy.optimizer.param_groups[0]["params"]
        model.policy.optimizer = optimizer_class(parameters, lr=0.01)

    return change


def load_other_weights(model):
    weights = {name: value * 0.5 for name, value in model.policy.state_dict().items()}
    model.policy.load_state_dict(weights)


def put(**attributes):
    return lambda model: vars(model).update(attributes)


def change_the_optimizer(model):
    model.policy.optimizer.param_groups[0].update(weight_decay=0.3, betas=(0.5, 0.7))


def seed_the_environment_anew(model):
    model.env.envs[0].unwrapped.np_random = np.random.default_rng(3)


CHANGES = {
    "optimizer's state": load_another_optimizer_state,
    "weights in place": weigh(0.7),
    "another optimizer": take(th.optim.RMSprop),
    "optimizer's settings": change_the_optimizer,
    "all parameters": lambda model: model.set_parameters(model.get_parameters()),
    "gamma": put(gamma=0.3),
    "norm": put(max_grad_norm=0.01),
    "rate": put(lr_schedule=FloatSchedule(0.03)),
    "generator": lambda model: setattr(model, "rng", np.random.default_rng(5)),
    "environment's generator": seed_the_environment_anew,
    "weights": load_other_weights,
    "clipping": put(clip_range=FloatSchedule(0.01)),
}


@pytest.fixture(scope="module")
def unchanged():
    return {k: learn(make("lake", k), "compiled", 250).policy.state_dict() for k in ("dqn", "ppo")}


OF_DQN = ("optimizer's state", "weights in place", "gamma", "weights", "clipping")


@pytest.mark.parametrize(
    ("what", "kind"), [*((what, "ppo") for what in CHANGES), *((what, "dqn") for what in OF_DQN)]
)
def test_a_change_counts_in_both_ways(what, kind, unchanged):
    change = CHANGES[what]
    models = [learn(make("lake", kind), mode, 250, Every(150, change)) for mode in MODES]
    assert_same(*models)
    ours = models[0].policy.state_dict()
    is_same = all(th.equal(value, unchanged[kind][name]) for name, value in ours.items())
    assert is_same == (what == "all parameters" or (what, kind) == ("clipping", "dqn"))


def freeze(model):
    model.policy.action_net.weight.requires_grad_(False)


FATAL = {
    "its optimizer is SGD, not Adam or RMSp": ("dqn", take(th.optim.SGD), "parts"),
    "some of its parameters are frozen": ("ppo", freeze, "compiled"),
}


@pytest.mark.parametrize("reason", FATAL)
def test_what_cannot_be_gone_on_with_ends_the_training(reason):
    kind, change, mode = FATAL[reason]
    with pytest.raises(ValueError, match=f"cannot go on: {reason}"):
        learn(make("lake", kind), mode, 400, Every(150, change))

"""Networks trained in three loops: the library's, the same with compiled parts, the compiled one.

The library, made to draw the numbers that compiled code draws, agrees up to rounding, also in every
weight after every step. The others end in the same bits, wherever blocks of steps end.
"""

import json
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn
from torch.distributions import Categorical

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon
from rl_yardstick.envs.wrappers import OneHotObservation
from tests.agents.trainings import Every, Plain

TOLERANCE = 1e-4  # what rounding comes to after a few hundred steps
STEPS = "time/total_timesteps"
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
ROLLOUT = ("observations", "actions", "rewards", "episode_starts", "values", "log_probs")
ROLLOUT += ("advantages", "returns")


LAKE = partial(gym.make, "FrozenLake-v1", max_episode_steps=6)
POLE = partial(gym.make, "CartPole-v1", max_episode_steps=9)


def vectors():
    return OneHotObservation(LAKE())


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


def normalised(env):
    """Statistics as they might be after a while."""
    env, rng = VecNormalize(env, clip_obs=1.5, clip_reward=0.8), np.random.default_rng(4)
    env.obs_rms.mean, env.obs_rms.var = rng.normal(size=(2, 3)), rng.uniform(0.3, 2, (2, 3))
    env.ret_rms.var = 7.0
    return env


def policy(optimizer=None, net_arch=(16,), activation_fn=nn.Tanh, **kwargs):
    """Settings of networks and of what moves their weights."""
    found = {"net_arch": net_arch, "activation_fn": activation_fn}
    if optimizer is not None:
        found |= {"optimizer_class": optimizer, "optimizer_kwargs": kwargs}
    return {"policy_kwargs": found}


Q = {"learning_starts": 20, "buffer_size": 120, "batch_size": 8, "target_update_interval": 10}
PPO = {"n_steps": 24, "batch_size": 16, "n_epochs": 2}
BY_A_FUNCTION = {"clip_range": lambda remaining: 0.05 + 0.2 * remaining}
CASES = {  # agent, environment, how many, episodes between two records, settings
    "dqn": ("dqn", LAKE, 1, 3, Q),
    "two environments": (
        "dqn", LAKE, 2, 3,
        {**Q, "gradient_steps": -1, "tau": 0.5, **policy(net_arch=[])}),
    "episodes": ("dqn", POLE, 1, 3, {**Q, "train_freq": (2, "episode"), "gradient_steps": -1}),
    "steps, greedy at once": (
        "dqn", vectors, 2, 3,
        {**Q, "n_steps": 3, "train_freq": 3, "gradient_steps": 2, "exploration_fraction": 0.0}),
    "double, tau": ("double_dqn", POLE, 2, 3, {**Q, "tau": 0.5}),
    "matrices": (
        "dqn", Matrices, 2, 3,
        {**Q, "n_steps": 3, "max_grad_norm": 0.1, "batch_size": 33,
         **policy(net_arch=[64, 64], activation_fn=nn.ReLU)}),
    "ppo, normalised": ("ppo", Matrices, 2, 3, {**PPO, **BY_A_FUNCTION, "wrap": normalised}),
    "ppo, a remainder of one": (
        "ppo", vectors, 2, 1, {**PPO, "n_steps": 25, "batch_size": 7, "clip_range_vf": 0.1}),
    "ppo on poles": ("ppo", POLE, 2, 3, {**PPO, "target_kl": 0.003}),
    "ppo by AdamW": (
        "ppo", Matrices, 1, 3,
        {**PPO, "normalize_advantage": False, **policy(th.optim.AdamW, weight_decay=3.0)}),
    "ppo, two networks": (
        "ppo", POLE, 1, 3,
        {**PPO, "max_grad_norm": 0.01, "ent_coef": 0.1,
         **policy(net_arch={"pi": [70, 1], "vf": []}, activation_fn=nn.ReLU)}),
    "a2c": (
        "a2c", LAKE, 2, 1, {"gamma": 0.9, "gae_lambda": 0.8, **policy(net_arch=[64, 64])}),
    "a2c with decay": (
        "a2c", POLE, 1, 3, policy(RMSpropTFLike, eps=1e-5, weight_decay=0.1)),
}  # fmt: skip


class Diary(BlockCallback):
    """Writes down what can be seen after each step."""

    def __init__(self):
        super().__init__()
        self.exact, self.close = [], []

    def horizon(self):
        return Horizon(calls=1)

    def _look(self, *arrays):
        """Counters, which agree, and weights and more, which do so up to rounding."""
        model = self.model
        self.exact.append((self.n_calls, model.num_timesteps, model._n_updates, model._episode_num))
        weights = [p.detach().numpy() for p in model.policy.parameters()]
        self.close.append(np.concatenate([*map(np.ravel, (*weights, *arrays))]))

    def _on_step(self):
        model, told = self.model, self.locals
        rates = model._current_progress_remaining, getattr(model, "exploration_rate", 0)
        self._look([*rates, model.policy.optimizer.param_groups[0]["lr"]])
        self.exact.append([told[k].tolist() for k in ("actions", "rewards", "dones", "new_obs")])
        self.exact.append([self._info(info) for info in told["infos"]])
        return True

    def _info(self, info):
        end, episode = info.get("terminal_observation"), info.get("episode")
        ended = None if end is None else np.array(end).tolist()
        return info["TimeLimit.truncated"], ended, episode and (episode["r"], episode["l"])


class RolloutDiary(Diary):
    """Also writes down where rollouts begin and end, so that environments are stepped in Python."""

    def _on_rollout_start(self):
        self._look()

    def _on_rollout_end(self):
        if hasattr(self.model, "replay_buffer"):
            self._look([self.model.replay_buffer.pos])
        else:
            assert self.model.rollout_buffer.full
            self._look(*(getattr(self.model.rollout_buffer, name) for name in ROLLOUT))


def make(case, engine="compiled"):
    name, env, n_envs, _, settings = CASES[case]
    settings = {"policy_kwargs": {"net_arch": [16]}, **settings}
    env = settings.pop("wrap", lambda env: env)(make_vec_env(env, n_envs, seed=3))
    rate = LinearSchedule(1e-2, 1e-3, 0.8)
    algorithm = load_algorithm(name)
    return algorithm("MlpPolicy", env, seed=5, engine=engine, learning_rate=rate, **settings)


def draw_as_compiled(patch, model, rng):
    """Let the library draw the numbers that compiled code draws, from this generator."""
    drawn, n_actions = [], int(model.action_space.n)

    def randint(low, high=None, size=None):
        if not drawn:
            limits = model.replay_buffer.size(), model.n_envs
            drawn.extend((rng.random((model.batch_size, 2)) * limits).astype(int).T)
        return drawn.pop(0)

    def permutation(n):
        numbers = np.arange(n)
        for i in range(n - 1, 0, -1):
            j = int(rng.random() * (i + 1))
            numbers[[i, j]] = numbers[[j, i]]
        # The library counts all steps of an environment before those of the next.
        return numbers % model.n_envs * model.n_steps + numbers // model.n_envs

    def sample(distribution):
        cumulative = distribution.probs.double().cumsum(dim=1).numpy()
        uniform = rng.random(len(cumulative))[:, np.newaxis]
        return th.as_tensor((cumulative[:, :-1] <= uniform).sum(axis=1))

    patch.setattr(np.random, "rand", rng.random)
    patch.setattr(np.random, "randint", randint)
    patch.setattr(np.random, "permutation", permutation)
    patch.setattr(Categorical, "sample", sample)
    patch.setattr(model.action_space, "sample", lambda: int(rng.random() * n_actions))


def unflattened(buffer, name):
    """An array of the rollout buffer, as it was before the library took it apart."""
    array, (n_steps, n_envs) = getattr(buffer, name), buffer.rewards.shape
    if len(array) == n_steps * n_envs and n_envs > 1:
        return array.reshape(n_envs, n_steps, -1).swapaxes(0, 1)
    return array.reshape(n_steps, n_envs, -1)


def state(model):
    """All that training has changed."""
    found = {f"policy.{key}": value.numpy() for key, value in model.policy.state_dict().items()}
    optimizer = model.policy.optimizer.state_dict()
    for i, kept in optimizer["state"].items():
        found |= {f"optimizer.{i}.{key}": np.asarray(value) for key, value in kept.items()}
    if hasattr(model, "replay_buffer"):
        found |= {name: getattr(model.replay_buffer, name) for name in REPLAY}
        found["ring"] = np.array([model.replay_buffer.pos, model.replay_buffer.full])
    elif model.rollout_buffer.full:  # a rollout that is given up is nothing
        found |= {name: unflattened(model.rollout_buffer, name) for name in ROLLOUT}
    names = ("num_timesteps", "_n_updates", "_episode_num", "_last_obs", "_n_calls")
    names += ("exploration_rate", "_current_progress_remaining", "_last_episode_starts")
    found |= {name: np.asarray(getattr(model, name)) for name in names if hasattr(model, name)}
    found["rate"] = np.asarray(optimizer["param_groups"][0]["lr"])
    found["episodes"] = np.array([(info["r"], info["l"]) for info in model.ep_info_buffer])
    generators = [model.rng, *(env.unwrapped.np_random for env in model.env.envs)]
    found["draws"] = np.array([g.bit_generator.state["state"]["state"] % 2**62 for g in generators])
    bases = [env.unwrapped for env in model.env.envs]
    found["places"] = np.array([getattr(base, "s", getattr(base, "state", 0)) for base in bases])
    return found


def assert_same(ours, theirs):
    assert ours.keys() == theirs.keys()
    assert [name for name in ours if not np.array_equal(ours[name], theirs[name])] == []


def followed(folder, case, engine, *callbacks):
    """A training that its diary, its log and its end tell of."""
    model = make(case, engine)
    model.set_logger(configure(str(folder), ["json"]))
    with pytest.MonkeyPatch.context() as patch:
        if engine == "library":
            draw_as_compiled(patch, model, model.rng)
        model.learn(303, callback=[*callbacks], log_interval=CASES[case][3])
    assert model.engine_in_use.startswith(engine)
    model.logger.close()
    records = map(json.loads, (folder / "progress.json").read_text().splitlines())
    of_the_clock = {"time/fps", "time/time_elapsed"}
    return model, [{k: r[k] for k in sorted(r.keys() - of_the_clock)} for r in records]


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
@pytest.mark.parametrize("case", CASES)
def test_compiled_training_does_what_the_library_does_wherever_blocks_end(case, tmp_path):
    theirs, ours, steps = RolloutDiary(), RolloutDiary(), Diary()
    library, expected = followed(tmp_path, case, "library", theirs, steps)
    model, dumps = followed(tmp_path, case, "compiled", ours)
    assert ours.exact == theirs.exact
    for each, other in zip(ours.close, theirs.close, strict=True):
        np.testing.assert_allclose(each, other, rtol=TOLERANCE, atol=TOLERANCE)
    names, others = ([(r[STEPS], [*r]) for r in records] for records in (dumps, expected))
    assert names == others
    logged, other = ([v for r in records for v in r.values()] for records in (dumps, expected))
    np.testing.assert_allclose(logged, other, rtol=1e-3, atol=1e-4)
    assert len(dumps) > (5 if hasattr(model, "replay_buffer") else 1)
    ended, end = state(library), state(model)
    assert ended.keys() == end.keys()
    for name, value in ended.items():
        np.testing.assert_allclose(end[name], value, rtol=TOLERANCE, atol=TOLERANCE, err_msg=name)
    if CASES[case][1] is Matrices:
        return
    # In compiled environments too, whether blocks end after each step or learn within the loop.
    rollouts = [of_rollouts(record) for record in dumps]
    for callbacks in ([again := Diary()], [Every(7), Every(30)]):
        model, found = followed(tmp_path, case, "compiled", *callbacks)
        assert model.engine_in_use == "compiled"
        assert_same(state(model), end)
        assert [of_rollouts(record) for record in found] == rollouts
    assert again.exact == steps.exact


def of_rollouts(record):
    return {key: value for key, value in record.items() if key.startswith(("rollout/", STEPS))}


@pytest.mark.parametrize("case", ["episodes", "ppo on poles"])
def test_a_training_that_was_stopped_goes_on(case):
    ends = []
    for plain in ([], [Plain()]):
        model = make(case).learn(1000, callback=[*plain, Every(123, lambda model: False)])
        assert model.num_timesteps == 123 * model.n_envs
        model.learn(300, callback=plain, reset_num_timesteps=False)
        assert model.engine_in_use.startswith("compiled but for") == bool(plain)
        ends.append(state(model))
    assert_same(*ends)

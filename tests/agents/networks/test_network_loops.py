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
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn
from torch.distributions import Categorical

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.common.callbacks import BlockCallback, Horizon
from envs.wrappers import OneHotObservation

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


def policy(optimizer=None, net_arch=(16,), activation_fn=nn.Tanh, **kwargs):
    """Settings of networks and of what moves their weights."""
    found = {"net_arch": net_arch, "activation_fn": activation_fn}
    if optimizer is not None:
        found |= {"optimizer_class": optimizer, "optimizer_kwargs": kwargs}
    return {"policy_kwargs": found}


Q = {"learning_starts": 20, "buffer_size": 120, "batch_size": 8, "target_update_interval": 10}
PPO = {"n_steps": 24, "batch_size": 16, "n_epochs": 2}
UNLIMITED = {"replay_buffer_kwargs": {"handle_timeout_termination": False}, "gamma": 0.9}
BY_A_FUNCTION = {"clip_range": lambda remaining: 0.05 + 0.2 * remaining}
CASES = {  # agent, environment, how many, episodes between two records, settings
    "dqn": ("dqn", lake, 1, 3, Q),
    "two environments": (
        "dqn", lake, 2, 3,
        {**Q, "gradient_steps": -1, "tau": 0.5, **policy(net_arch=[])}),
    "episodes": ("dqn", pole, 1, 3, {**Q, "train_freq": (2, "episode"), "gradient_steps": -1}),
    "steps, greedy at once": (
        "dqn", vectors, 2, 3,
        {**Q, "n_steps": 3, "train_freq": 3, "gradient_steps": 2, "exploration_fraction": 0.0}),
    "double": ("double_dqn", pole, 2, 3, {**Q, "tau": 0.5}),
    "deep": ("deep_qlearning", lake, 1, 3, {**Q, "exploration_fraction": 0.5}),
    "narrow, no time limits": (
        "dqn", lake, 1, 3,
        {**Q, **UNLIMITED, **policy(net_arch=[70, 1, 3], activation_fn=nn.Identity)}),
    "matrices": (
        "dqn", Matrices, 2, 3,
        {**Q, "n_steps": 3, "max_grad_norm": 0.1, "batch_size": 33,
         **policy(net_arch=[64, 64], activation_fn=nn.ReLU)}),
    "normalised rewards": (
        "deep_qlearning", Matrices, 1, 3, {**Q, "wrap": partial(normalised, norm_obs=False)}),
    "ppo, normalised": ("ppo", Matrices, 2, 3, {**PPO, **BY_A_FUNCTION, "wrap": normalised}),
    "ppo": ("ppo", lake, 2, 3, {**PPO, "clip_range": LinearSchedule(0.3, 0.1, 1.0)}),
    "ppo, a remainder of one": (
        "ppo", vectors, 2, 1, {**PPO, "n_steps": 25, "batch_size": 7, "clip_range_vf": 0.1}),
    "ppo on poles": ("ppo", pole, 2, 3, {**PPO, "target_kl": 0.003}),
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
    "a2c": (
        "a2c", lake, 2, 1, {"gamma": 0.9, "gae_lambda": 0.8, **policy(net_arch=[64, 64])}),
    "a2c by RMSprop": (
        "a2c", pole, 1, 3,
        {"normalize_advantage": True, "ent_coef": 0.1, **policy(th.optim.RMSprop, eps=1e-5)}),
    "a2c with decay": (
        "a2c", pole, 1, 3, policy(RMSpropTFLike, eps=1e-5, weight_decay=0.1)),
}  # fmt: skip


class Plain(BaseCallback):
    """Has to be asked after each step, so that the library's loop runs with compiled parts."""

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
    """Writes down what can be seen after each step, and where rollouts begin and end."""

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

    def _on_rollout_start(self):
        self._look()

    def _on_rollout_end(self):
        if hasattr(self.model, "replay_buffer"):
            self._look([self.model.replay_buffer.pos])
        else:
            assert self.model.rollout_buffer.full
            self._look(*(getattr(self.model.rollout_buffer, name) for name in ROLLOUT))

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


def make(case, engine="compiled"):
    name, env, n_envs, _, settings = CASES[case]
    wrap = settings.get("wrap", lambda env: env)
    settings = {"policy_kwargs": {"net_arch": [16]}, **settings}
    settings.pop("wrap", None)
    env, rate = wrap(make_vec_env(env, n_envs, seed=3)), LinearSchedule(1e-2, 1e-3, 0.8)
    algorithm = load_algorithm(name)
    return algorithm("MlpPolicy", env, seed=5, engine=engine, learning_rate=rate, **settings)


def learn(model, mode, steps, *callbacks, **kwargs):
    """Train in compiled parts, or in the compiled loop where the environment has a model."""
    model.learn(steps, callback=[*callbacks, *[Plain()] * (mode == "parts")], **kwargs)
    assert mode != "compiled" or model.engine_in_use == "compiled"
    assert mode != "parts" or model.engine_in_use.startswith("compiled but for")
    return model


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


def followed(case, engine, *callbacks):
    """A training that its diary, its log and its end tell of."""
    model, lists = make(case, engine), Lists()
    model.set_logger(Logger(None, [lists]))
    with pytest.MonkeyPatch.context() as patch:
        if engine == "library":
            draw_as_compiled(patch, model, model.rng)
        model.learn(303, callback=[*callbacks], log_interval=CASES[case][3])
    assert model.engine_in_use.startswith(engine)
    return model, lists.dumps


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
@pytest.mark.parametrize("case", CASES)
def test_compiled_training_does_what_the_library_does_wherever_blocks_end(case):
    theirs, ours = Diary(), Diary()
    (library, expected), (model, dumps) = (
        followed(case, "library", theirs), followed(case, "compiled", ours)
    )  # fmt: skip
    assert ours.exact == theirs.exact
    for each, other in zip(ours.close, theirs.close, strict=True):
        np.testing.assert_allclose(each, other, rtol=TOLERANCE, atol=TOLERANCE)
    assert [(step, [*record]) for step, record in dumps] == [
        (step, [*record]) for step, record in expected
    ]
    logged, other = (
        [v for _, record in each for v in record.values()] for each in (dumps, expected)
    )
    np.testing.assert_allclose(logged, other, rtol=1e-3, atol=1e-4)
    assert len(dumps) > (5 if hasattr(model, "replay_buffer") else 1)
    ended, end = state(library), state(model)
    assert ended.keys() == end.keys()
    for name, value in ended.items():
        np.testing.assert_allclose(end[name], value, rtol=TOLERANCE, atol=TOLERANCE, err_msg=name)
    if model.engine_in_use == "compiled":
        # Without a diary, blocks are longer and learn within the loop.
        for callbacks in ([], [Every(7), Every(30)], [Plain()]):
            again, found = followed(case, "compiled", *callbacks)
            assert_same(state(again), end)
            assert found == dumps


@pytest.mark.parametrize("place", [(9, False), (9, True), (0, True), (29, True)])
@pytest.mark.parametrize("n_steps", [2, 5, 40])
def test_returns_over_several_steps(n_steps, place):
    """Values of next states would hide what a minibatch holds: it is looked at itself."""
    env = make_vec_env(lake, 2, seed=3)
    model = load_algorithm("dqn")(
        "MlpPolicy", env, seed=5, buffer_size=60, n_steps=n_steps, batch_size=400, engine="compiled"
    )
    model._setup_learn(1)
    assert isinstance(model.replay_buffer, NStepReplayBuffer)
    buffer, rng = model.replay_buffer, np.random.default_rng(3)
    buffer.next_observations[:] = rng.integers(16, size=buffer.next_observations.shape)
    buffer.rewards[:] = rng.normal(scale=2, size=buffer.rewards.shape)
    # Some end episodes, by a time limit or not.
    buffer.dones[:] = rng.random(buffer.dones.shape) < 0.3
    buffer.timeouts[:] = buffer.dones * (rng.random(buffer.dones.shape) < 0.5)
    buffer.pos, buffer.full = place
    rng.bit_generator.state = model.rng.bit_generator.state
    with model._learning_compiled():
        held = model._shared_training().held
        held.target[:] = 0  # where all values are zero, rewards stay what they were
        model.train(1, 400)
        batch = held.batch
        ours = [each.copy() for each in (batch.rewards, batch.discounts, batch.next_states.indices)]
    with pytest.MonkeyPatch.context() as patch:
        draw_as_compiled(patch, model, rng)
        samples = buffer.sample(400)
    discounts = (samples.discounts * (1 - samples.dones)).numpy().ravel()
    np.testing.assert_allclose(ours[0], samples.rewards.numpy().ravel(), rtol=0, atol=1e-5)
    np.testing.assert_allclose(ours[1], discounts, rtol=1e-6)
    np.testing.assert_array_equal(ours[2], samples.next_observations.numpy().ravel())


# --- stops and changes ---------------------------------------------------------------------------

MODES = ("parts", "compiled")


@pytest.mark.parametrize("case", ["steps, greedy at once", "episodes", "ppo on poles", "a2c"])
def test_a_training_that_was_stopped_goes_on(case):
    ends = []
    for mode in MODES:
        model = learn(make(case), mode, 1000, Every(123, lambda model: False))
        assert model.num_timesteps == 123 * model.n_envs
        ends.append(state(learn(model, mode, 300, reset_num_timesteps=False)))
    assert_same(*ends)


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


def put(**attributes):
    return lambda model: vars(model).update(attributes)


CHANGES = {
    "optimizer's state": load_another_optimizer_state,
    "weights in place": weigh(0.7),
    "another optimizer": take(th.optim.RMSprop),
    "all parameters": lambda model: model.set_parameters(model.get_parameters()),
    "gamma": put(gamma=0.3),
    "rate": put(lr_schedule=FloatSchedule(0.03)),
    "generator": lambda model: setattr(model, "rng", np.random.default_rng(5)),
    "clipping": put(clip_range=FloatSchedule(0.01)),
}


@pytest.fixture(scope="module")
def unchanged():
    return {k: learn(make(k), "compiled", 250).policy.state_dict() for k in ("dqn", "ppo")}


OF_DQN = ("optimizer's state", "weights in place", "gamma")


@pytest.mark.parametrize(
    ("what", "kind"), [*((what, "ppo") for what in CHANGES), *((what, "dqn") for what in OF_DQN)]
)
def test_a_change_counts_in_both_ways(what, kind, unchanged):
    change = CHANGES[what]
    models = [learn(make(kind), mode, 250, Every(90, change)) for mode in MODES]
    assert_same(*map(state, models))
    ours = models[0].policy.state_dict()
    is_same = all(th.equal(value, unchanged[kind][name]) for name, value in ours.items())
    assert is_same == (what == "all parameters")


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
        learn(make(kind), mode, 400, Every(150, change))

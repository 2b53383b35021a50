"""The compiled loop ends in the same bits as the library's own loop with compiled acting and
learning, wherever blocks of steps end and whatever callbacks there are.
"""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.common.callbacks import BlockCallback, EpisodeBudget, Horizon, calls_until_multiple
from agents.networks.engine import NetworkEngine
from envs.wrappers import OneHotObservation

ENVS = {
    "FrozenLake": partial(gym.make, "FrozenLake-v1", max_episode_steps=12),
    "vectors": lambda: OneHotObservation(gym.make("FrozenLake-v1", max_episode_steps=12)),
    "CartPole": partial(gym.make, "CartPole-v1", max_episode_steps=30),
    "Warehouse": partial(gym.make, "Warehouse-v0", max_episode_steps=20),
    "Taxi": partial(gym.make, "Taxi-v4", max_episode_steps=25),
}
Q = {"learning_starts": 50, "buffer_size": 150, "batch_size": 16, "target_update_interval": 20}
KINDS = {
    "dqn": ("dqn", 1, {**Q, "train_freq": 1, "tau": 0.5}),
    "dqn, two": ("dqn", 2, {**Q, "train_freq": 3, "gradient_steps": -1, "n_steps": 3}),
    "dqn, episodes": ("dqn", 1, {**Q, "train_freq": (1, "episode"), "gradient_steps": 5}),
    "double": ("double_dqn", 2, {**Q, "n_steps": 2}),
    "deep": ("deep_qlearning", 1, Q),
    "ppo": ("ppo", 1, {"n_steps": 64, "n_epochs": 3, "target_kl": 0.02}),
    "ppo, two": ("ppo", 2, {"n_steps": 50, "batch_size": 25, "clip_range_vf": 0.2}),
    "a2c": ("a2c", 2, {"normalize_advantage": True}),
}
ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
ARRAYS += ("episode_starts", "values", "log_probs", "advantages", "returns")


class Plain(BaseCallback):
    """Has to be asked after each step."""

    def _on_step(self):
        return True


def make(env, kind, **kwargs):
    name, n_envs, settings = KINDS[kind]
    return load_algorithm(name)(
        "MlpPolicy",
        make_vec_env(ENVS[env], n_envs, seed=2),
        seed=1,
        learning_rate=LinearSchedule(0.01, 0.001, 1.0),
        policy_kwargs={"net_arch": [24, 8]},
        **{"engine": "compiled", **settings, **kwargs},
    )


def learn(model, mode, steps, *callbacks, **kwargs):
    asked = [*callbacks, Plain()] if mode == "parts" else [*callbacks]
    model.learn(steps, callback=CallbackList(asked), **kwargs)
    assert model.engine_in_use.startswith("compiled but for" if mode == "parts" else "compiled")
    assert (model.engine_in_use == "compiled") == (mode == "compiled")
    return model


def state(model):
    """All that training has changed."""
    found = {f"policy.{key}": value.numpy() for key, value in model.policy.state_dict().items()}
    optimizer = model.policy.optimizer.state_dict()
    for i, kept in optimizer["state"].items():
        found |= {f"optimizer.{i}.{key}": np.asarray(value) for key, value in kept.items()}
    buffer = model.replay_buffer if hasattr(model, "replay_buffer") else model.rollout_buffer
    if hasattr(model, "replay_buffer") or buffer.full:  # a rollout that is given up is nothing
        found |= {name: getattr(buffer, name) for name in ARRAYS if hasattr(buffer, name)}
    names = ("num_timesteps", "_n_updates", "_episode_num", "_last_obs", "_n_calls")
    names += ("exploration_rate", "_current_progress_remaining", "_last_episode_starts")
    found |= {name: np.asarray(getattr(model, name)) for name in names if hasattr(model, name)}
    found["rate"] = np.asarray(optimizer["param_groups"][0]["lr"])
    found["episodes"] = np.array([(info["r"], info["l"]) for info in model.ep_info_buffer])
    found["draws"] = np.asarray(model.rng.bit_generator.state["state"]["state"] % 2**62)
    for i, env in enumerate(model.env.envs):
        drawn = env.unwrapped.np_random.bit_generator.state["state"]["state"] % 2**62
        found[f"draws of {i}"] = np.asarray(drawn)
        name = "s" if hasattr(env.unwrapped, "s") else "state"
        found[f"state of {i}"] = np.asarray(getattr(env.unwrapped, name))
    return found


def assert_same(ours, theirs):
    ours, theirs = state(ours), state(theirs)
    assert ours.keys() == theirs.keys()
    different = [name for name in ours if not np.array_equal(ours[name], theirs[name])]
    assert not different


PAIRS = [(env, kind) for env in ("FrozenLake", "CartPole") for kind in KINDS]
PAIRS += [
    (env, kind) for env in ("vectors", "Warehouse", "Taxi") for kind in ("dqn, two", "ppo, two")
]


@pytest.mark.parametrize(("env", "kind"), PAIRS)
def test_both_ways_end_in_the_same_bits(env, kind):
    models = [learn(make(env, kind), mode, 500) for mode in ("parts", "compiled")]
    assert models[0]._n_updates > 0
    assert len(models[0].ep_info_buffer) > 5
    assert_same(*models)


@pytest.mark.parametrize("kind", KINDS)
def test_how_long_blocks_are_does_not_matter(kind, monkeypatch):
    expected = learn(make("FrozenLake", kind), "compiled", 500)
    for lengths in ([1], [7, 30]):
        turns = iter(lengths * 1000)

        def set_length(engine, n_steps, seconds, turns=turns):
            engine.steps_at_once = next(turns)

        monkeypatch.setattr(NetworkEngine, "_note_speed", set_length)
        assert_same(learn(make("FrozenLake", kind), "compiled", 500), expected)


CALLBACKS = {
    "checkpoints": lambda folder: [CheckpointCallback(77, folder)],
    "evaluation": lambda folder: [
        EvalCallback(make_vec_env(ENVS["CartPole"], seed=9), eval_freq=110, n_eval_episodes=2)
    ],
    "budget": lambda folder: [EpisodeBudget(15)],
    "at most so many": lambda folder: [StopTrainingOnMaxEpisodes(8)],
}


@pytest.mark.filterwarnings("ignore:Training and eval env are not of the same type")
@pytest.mark.parametrize("kind", ["dqn", "dqn, two", "ppo, two", "a2c"])
@pytest.mark.parametrize("what", CALLBACKS)
def test_callbacks_find_and_leave_the_same(what, kind, tmp_path):
    models, scores = [], []
    for mode in ("parts", "compiled"):
        callbacks = CALLBACKS[what](tmp_path / mode)
        models.append(learn(make("CartPole", kind), mode, 700, *callbacks))
        scores.append(getattr(callbacks[0], "last_mean_reward", None))
    assert_same(*models)
    assert scores[0] == scores[1]
    assert (models[0].num_timesteps < 700) == (what in {"budget", "at most so many"})
    files = [sorted(path.name for path in (tmp_path / mode).glob("*")) for mode in MODES]
    assert files[0] == files[1]
    assert len(files[0]) == (what == "checkpoints") * (700 // models[0].n_envs // 77)


MODES = ("parts", "compiled")


@pytest.mark.parametrize(
    ("env", "kind"),
    [("vectors", "dqn, two"), ("vectors", "ppo, two"), *(("CartPole", kind) for kind in KINDS)],
)
def test_a_training_that_was_stopped_is_gone_on_with(kind, env):
    models = []
    for mode in MODES:
        model = learn(make(env, kind), mode, 1000, Stop(123))
        learn(model, mode, 300, reset_num_timesteps=False)
        models.append(model)
    assert_same(*models)


class Stop(BlockCallback):
    """Ends training on that call."""

    def __init__(self, n):
        super().__init__()
        self.n = n

    def horizon(self):
        return Horizon(calls=self.n - self.n_calls)

    def _on_step(self):
        return self.n_calls < self.n


class LogReader(BlockCallback):
    """Keeps what the log says now and then, and has it written down and forgotten now and then."""

    every_n_steps = 37

    def __init__(self):
        super().__init__()
        self.read = []

    def _on_step(self):
        said = self.logger.name_to_value.items()
        self.read.append(
            {name: value for name, value in said if name.startswith(("train/", "rollout/expl"))}
        )
        if len(self.read) % 2:
            self.logger.dump(self.num_timesteps)
        return True


@pytest.mark.parametrize("kind", KINDS)
def test_callbacks_read_the_same_log(kind):
    """What was learnt just before, and under the names that the library has."""
    readers = {mode: LogReader() for mode in MODES}
    for mode, reader in readers.items():
        learn(make("CartPole", kind), mode, 500, reader, log_interval=None)
    ours = readers["compiled"].read
    assert len(ours) == 13
    for read, expected in zip(ours, readers["parts"].read, strict=True):
        assert read == pytest.approx(expected, nan_ok=True)
    library = LogReader()
    model = make("CartPole", kind, engine="library")
    model.learn(500, callback=library, log_interval=None)
    if kind != "dqn, episodes":  # which end elsewhere: it draws other numbers
        assert [read.keys() for read in ours] == [read.keys() for read in library.read]


class Change(BlockCallback):
    """Changes the agent once."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def horizon(self):
        return Horizon(calls=calls_until_multiple(self.n_calls, 150))

    def _on_step(self):
        if self.n_calls == 150:
            self.change(self.model)
        return True


def load_other_weights(model):
    state = {name: value * 0.5 for name, value in model.policy.state_dict().items()}
    model.policy.load_state_dict(state)


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


def put_other_weights_in_place(model):
    for parameter in model.policy.parameters():
        parameter.data = parameter.data * 0.7


def take_another_optimizer(model):
    parameters = model.policy.optimizer.param_groups[0]["params"]
    model.policy.optimizer = th.optim.RMSprop(parameters, lr=0.01)


def decay_weights(model):
    model.policy.optimizer.param_groups[0].update(weight_decay=0.3, betas=(0.5, 0.7))


CHANGES = {
    "optimizer's state": load_another_optimizer_state,
    "weights in place": put_other_weights_in_place,
    "another optimizer": take_another_optimizer,
    "optimizer's settings": decay_weights,
    "all parameters": lambda model: model.set_parameters(model.get_parameters()),
    "gamma": lambda model: setattr(model, "gamma", 0.3),
    "norm": lambda model: setattr(model, "max_grad_norm", 0.01),
    "rate": lambda model: setattr(model, "lr_schedule", FloatSchedule(0.03)),
    "generator": lambda model: setattr(model, "rng", np.random.default_rng(5)),
    "environment's generator": lambda model: setattr(
        model.env.envs[0].unwrapped, "np_random", np.random.default_rng(3)
    ),
    "weights": load_other_weights,
    "clipping": lambda model: setattr(model, "clip_range", FloatSchedule(0.01)),
}


@pytest.mark.parametrize("kind", ["dqn", "ppo"])
@pytest.mark.parametrize("what", CHANGES)
def test_a_change_counts_in_both_ways(what, kind):
    if what == "clipping" and kind == "dqn":
        return
    models = [learn(make("FrozenLake", kind), mode, 400, Change(CHANGES[what])) for mode in MODES]
    assert_same(*models)
    unchanged = learn(make("FrozenLake", kind), "compiled", 400).policy.state_dict()
    ours = models[0].policy.state_dict()
    is_same = all(th.equal(value, unchanged[name]) for name, value in ours.items())
    assert is_same == (what == "all parameters")


def test_a_state_that_is_loaded_before_the_first_step_stays():
    """Where nothing has been learnt yet, nothing is remembered that would have to be forgotten."""
    taught = make("FrozenLake", "dqn")
    learn(taught, "compiled", 200)
    state = taught.policy.optimizer.state_dict()
    model = make("FrozenLake", "dqn", learning_starts=10_000)
    load = Change(lambda model: model.policy.optimizer.load_state_dict(state))
    found = learn(model, "compiled", 200, load).policy.optimizer.state_dict()["state"]
    for i, kept in state["state"].items():
        assert all(th.equal(found[i][name], value) for name, value in kept.items())


@pytest.mark.parametrize("mode", MODES)
def test_an_optimizer_that_is_not_known_ends_the_training(mode):
    def take(model):
        parameters = model.policy.optimizer.param_groups[0]["params"]
        model.policy.optimizer = th.optim.SGD(parameters, lr=0.01)

    with pytest.raises(ValueError, match="cannot go on: its optimizer is SGD, not Adam or RMSp"):
        learn(make("FrozenLake", "dqn"), mode, 400, Change(take))


def freeze(model):
    model.policy.action_net.weight.requires_grad_(False)


@pytest.mark.parametrize("mode", MODES)
def test_so_do_parameters_that_are_frozen_meanwhile(mode):
    with pytest.raises(ValueError, match="cannot go on: some of its parameters are frozen"):
        learn(make("FrozenLake", "ppo"), mode, 400, Change(freeze))


class Counting(BlockCallback):
    """Changes what is learnt at the end of each rollout, and counts what it is told."""

    def __init__(self):
        super().__init__()
        self.n_starts = self.n_ends = 0

    def _on_rollout_start(self):
        self.n_starts += 1

    def _on_rollout_end(self):
        self.n_ends += 1
        self.model.gamma = 0.5 + 0.4 * (self.n_ends % 2)
        self.model.lr_schedule = FloatSchedule(0.01 / self.n_ends)
        if hasattr(self.model, "rollout_buffer"):
            self.model.rollout_buffer.advantages *= self.n_ends % 3

    def _on_step(self):
        return True


@pytest.mark.parametrize("kind", ["dqn", "dqn, two", "dqn, episodes", "ppo, two", "a2c"])
def test_rollouts_are_told_of_where_they_are_heeded(kind):
    counts = [Counting(), Counting()]
    models = [
        learn(make("CartPole", kind), mode, 600, count)
        for mode, count in zip(MODES, counts, strict=True)
    ]
    assert_same(*models)
    assert counts[0].n_starts == counts[1].n_starts > 3
    assert counts[0].n_ends == counts[1].n_ends > 3

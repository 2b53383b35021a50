"""Agents on the library's classes, by hand and against it; and the two that do not learn."""

import itertools
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import sb3_contrib
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn
from torch.nn.utils import parameters_to_vector

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import EpisodeBudget
from rl_yardstick.agents.common.schedules import ExponentialSchedule, library_schedule
from rl_yardstick.agents.library import DeepQLearning, DoubleDQN, double_q_values
from rl_yardstick.agents.planning import AngleAgent, RandomAgent
from rl_yardstick.agents.random_search import ARS
from rl_yardstick.envs.wrappers import ActionMasks
from tests.agents.trainings import Every, Plain, Unknown

SETTINGS = {"learning_starts": 50, "train_freq": 4, "batch_size": 16, "buffer_size": 500, "seed": 0}


def test_target_by_hand():
    online, target = nn.Linear(1, 3, bias=False), nn.Linear(1, 3, bias=False)
    with th.no_grad():
        online.weight[:] = th.tensor([[1.0], [3.0], [2.0]])
        target.weight[:] = th.tensor([[7.0], [-5.0], [9.0]])
        # For a positive observation the online network prefers action 1, for a negative one 0.
        values = double_q_values(online, target, th.tensor([[2.0], [-1.0]]))
    assert values.tolist() == [[-10.0], [-7.0]]


# Errors -10 - 2 = -12 and 1 + 0.5 * 8 - 3 = 2: (144 + 4) / 2 / 2. Returns of several steps bring
# their own discounts: 1 + 0.25 * 8 - 3 = 0.
@pytest.mark.parametrize(("discounts", "loss"), [(None, 37.0), (th.full((2, 1), 0.25), 36.0)])
def test_squared_loss_by_hand(discounts, loss):
    """Of a terminal transition and one that goes on; rewards are -10 and 1."""
    model = DeepQLearning("MlpPolicy", "FrozenLake-v1", gamma=0.5)
    model.q_net = lambda obs: th.tensor([[5.0, 2.0], [3.0, 4.0], [8.0, 7.0]])[obs[:, 0]]
    batch = ReplayBufferSamples(
        observations=th.tensor([[0], [1]]),
        actions=th.tensor([[1], [0]]),
        next_observations=th.tensor([[2], [2]]),
        dones=th.tensor([[1.0], [0.0]]),
        rewards=th.tensor([[-10.0], [1.0]]),
        discounts=discounts,
    )
    assert model._loss(batch).item() == loss


@pytest.mark.parametrize(
    ("algorithm", "env_id"), [(DoubleDQN, "CartPole-v1"), (DeepQLearning, "FrozenLake-v1")]
)
def test_where_it_is_dqn_to_the_bit(algorithm, env_id):
    """Where its target network is the online one; and where no error exceeds 1, as Huber has it."""
    arguments = {**SETTINGS, "exploration_fraction": 1, "target_update_interval": 1}
    models = [each("MlpPolicy", env_id, **arguments).learn(250) for each in (DQN, algorithm)]
    weights = [parameters_to_vector(model.q_net.parameters()) for model in models]
    assert th.equal(*weights)


def ars(n_envs=1, algorithm=ARS, **kwargs):
    env = make_vec_env("CartPole-v1", n_envs, seed=0)
    return algorithm("LinearPolicy", env, seed=0, n_delta=2, **kwargs)


def test_a_budget_of_episodes_ends_the_search():
    plain = Plain()
    model = ars(2).learn(10**12, callback=[plain, EpisodeBudget(7)])
    assert sum(plain.ended) >= 7 > sum(plain.ended[:-1])
    assert model.num_timesteps == 2 * plain.n_calls


def test_what_was_loaded_goes_on_from_its_weights(tmp_path):
    """In the library the search begins at new random ones where zero_policy is off."""
    model = ars(zero_policy=False).learn(300)
    learnt, done = parameters_to_vector(model.policy.parameters()), model.num_timesteps
    assert learnt.abs().max() > 0
    assert th.equal(model.weights, learnt)
    model.save(tmp_path / "ars")
    loaded = ARS.load(tmp_path / "ars", env=model.get_env(), seed=1, learning_rate=0.0)
    assert th.equal(loaded.weights, learnt)
    loaded.learn(50, reset_num_timesteps=False)
    assert th.equal(parameters_to_vector(loaded.policy.parameters()), learnt)
    model.learn(300, reset_num_timesteps=False)  # schedules go on, too
    assert 0 < model._current_progress_remaining <= 1 - done / (done + 300)


def test_the_search_itself_is_the_librarys():
    ours, theirs = ars().learn(200), ars(algorithm=sb3_contrib.ARS).learn(200)
    assert ours.num_timesteps == theirs.num_timesteps
    assert th.equal(ours.weights, theirs.weights)


BOX = spaces.Box(np.array([-1, 0], np.float32), np.array([1, 10], np.float32))
NUMBERED = {  # a space: its shape, its options, and the number of the one that was chosen
    "Discrete": (spaces.Discrete(5), (), 5, lambda actions: actions),
    "MultiDiscrete": (spaces.MultiDiscrete([2, 3]), (2,), 6, lambda a: 3 * a[:, 0] + a[:, 1]),
    "Box": (BOX, (2,), 4, lambda a: np.floor((a - BOX.low) / [1, 5]).astype(int) @ [2, 1]),
}


@pytest.mark.parametrize("kind", NUMBERED)
def test_random_actions_are_uniform_and_follow_the_seed(kind):
    (space, shape, n_options, number), n = NUMBERED[kind], 5000

    def drawn():
        agent = RandomAgent("RandomPolicy", Unknown(actions=space), seed=7)
        return agent.predict(np.zeros((n, 2), np.float32), deterministic=False)[0]

    actions = drawn()
    assert actions.shape == (n, *shape)
    frequencies, share = np.bincount(number(actions), minlength=n_options) / n, 1 / n_options
    # Four standard errors of a frequency.
    np.testing.assert_allclose(frequencies, share, atol=4 * np.sqrt(share * (1 - share) / n))
    np.testing.assert_array_equal(drawn(), actions)


def test_the_cart_is_pushed_to_where_the_pole_leans():
    agent = AngleAgent("AnglePolicy", "CartPole-v1")
    # Whatever the position and the velocities say.
    for angle, others in itertools.product((-0.2, -1e-6, 0.0, 1e-6, 0.2), (-2.0, 2.0)):
        action, _ = agent.predict(np.array([others, others, angle, others], np.float32))
        assert action == (1 if angle > 0 else 0)


def lake():
    return make_vec_env("FrozenLake-v1", 8, seed=0)


def made(name, env, policy="MlpPolicy", **kwargs):
    return load_algorithm(name)(policy, env, device="cpu", seed=0, **kwargs)


LONG, FEW = 200_000, 2_000
TOO_SHORT = "library: so short a training is not worth compiling"
BRIDGED = "compiled but for the environment: "
AUTO = {"engine": "auto"}
PLANS = [
    # agent, settings, environment, callback, budget, what is chosen
    ("ppo", {}, lake, None, LONG, "library"),
    ("deep_qlearning", {}, lake, None, LONG, "compiled"),
    ("dqn", AUTO, lake, None, LONG, "compiled"),
    ("dqn", AUTO, lake, None, FEW, TOO_SHORT),
    # A rollout is collected to its end, which here takes 16,384 steps.
    ("ppo", AUTO, lake, None, FEW, "compiled"),
    ("double_dqn", {"engine": "compiled"}, lake, None, 1, "compiled"),
    # Not the steps count, but what is learnt from them.
    ("dqn", {**AUTO, "learning_starts": LONG}, lambda: gym.make("CartPole-v1"), None,
     10_000, TOO_SHORT),
    # Callbacks move the environment to Python, and never the engine.
    ("double_dqn", {}, lake, lambda: Every(1000), LONG, "compiled"),
    ("double_dqn", {}, lake, Plain, LONG, f"{BRIDGED}Plain must be asked after each step"),
    ("double_dqn", {}, lake, lambda: [EpisodeBudget(10)], 10**12, TOO_SHORT),
]  # fmt: skip


@pytest.mark.parametrize("case", range(len(PLANS)))
def test_which_engine_trains(case):
    name, settings, env, callback, budget, chosen = PLANS[case]
    model = made(name, env(), **settings)
    assert str(model.engine_plan(budget, callback and callback())) == chosen


class OwnDQN(load_algorithm("dqn")):
    """A user's own."""

    def train(self, gradient_steps, batch_size=100):
        pass


REFUSALS = {  # reason: agent, environment, settings
    "it masks actions": (
        "dqn", lambda: ActionMasks(gym.make("Warehouse-v0")), {"mask_actions": True}),
    "actions are Box, not Discrete": ("ppo", lambda: gym.make("Pendulum-v1"), {}),
    "a network has a layer of Hardtanh": (
        "ppo", Unknown, {"policy_kwargs": {"activation_fn": nn.Hardtanh}}),
    "OwnDQN may do things in Python of its own": (OwnDQN, Unknown, {}),
    "some of its parameters are frozen": ("ppo", Unknown, {}),
}  # fmt: skip


@pytest.mark.parametrize("reason", REFUSALS)
def test_compiled_says_why_not_and_auto_falls_back(reason):
    name, env, settings = REFUSALS[reason]
    settings = {
        "policy": "MlpPolicy",
        **({"n_steps": 32, "batch_size": 32} if name == "ppo" else {}),
        **settings,
    }
    algorithm = name if isinstance(name, type) else load_algorithm(name)
    model = algorithm(env=env(), engine="compiled", **settings)
    if "frozen" in reason:
        model.policy.value_net.weight.requires_grad_(False)
    with pytest.raises(ValueError, match=f"^engine: compiled is not possible: {reason}$"):
        model.learn(30)
    model.engine = "auto"
    model.learn(30)
    assert model.engine_in_use == f"library: {reason}"
    assert model.num_timesteps >= 30


@pytest.mark.parametrize(("name", "at_end"), [("dqn", True), ("ppo", False)])
def test_states_that_networks_have_no_weights_for_are_refused(name, at_end):
    """Compiled code would read whatever lies behind the weights."""
    model = made(name, Unknown(spaces.Discrete(3), shown=3, ends=float(at_end)), engine="compiled")
    with pytest.raises(ValueError, match=r"observation 3 is not in Discrete\(3\)"):
        model.learn(100)


def test_a_training_that_diverges_is_ended():
    env = Unknown(shown=np.full(2, np.nan, np.float32), ends=0)
    for name in ("ppo", "a2c"):
        model = made(name, env, n_steps=64, engine="compiled")
        with pytest.raises(ValueError, match="training has diverged"):
            model.learn(100)
    model = made("dqn", env, engine="compiled", buffer_size=100, learning_starts=10).learn(100)
    assert all(bool(p.isnan().all()) for p in model.q_net.parameters())


Q = {"learning_starts": 50, "buffer_size": 400, "target_update_interval": 20}
FALLING = library_schedule(ExponentialSchedule(0.001, 0.0001))
AGENTS = {
    "double_dqn": ("DQN", "CartPole-v1", Q),
    "ppo": (
        "PPO", "FrozenLake-v1",
        {"n_steps": 64, "n_epochs": 2, "learning_rate": FALLING, "clip_range": FALLING}),
}  # fmt: skip
ELSEWHERE = """
import sys
sys.modules["rl_yardstick"] = None  # as where it is not installed
import gymnasium, stable_baselines3, torch
for line in sys.stdin.read().splitlines():
    kind, path, env = line.split("|")
    model = getattr(stable_baselines3, kind).load(path, env=gymnasium.make(env), device="cpu")
    before = torch.cat([p.detach().flatten() for p in model.policy.parameters()])
    model.learn(200, reset_num_timesteps=False)
    after = torch.cat([p.detach().flatten() for p in model.policy.parameters()])
    print(path, bool((before != after).any()), bool(after.isfinite().all()), sep="|")
"""


def saved(name, folder, env, asked=()):
    """A model after a training with a checkpoint, which has been saved."""
    model = made(name, make_vec_env(env, seed=0), engine="compiled", **AGENTS[name][2])
    model.learn(300, callback=[CheckpointCallback(200, folder), *asked]).save(folder / "after")
    assert model.engine_in_use.startswith("compiled")
    return model


def steps_of(model):
    return {float(kept["step"]) for kept in model.policy.optimizer.state.values()}


def test_files_open_where_this_project_is_not(tmp_path):
    lines, expected = [], []
    for name, (kind, env, _) in AGENTS.items():
        saved(name, tmp_path / name, env)
        for path in (tmp_path / name / "rl_model_200_steps.zip", tmp_path / name / "after.zip"):
            lines.append(f"{kind}|{path}|{env}")
            expected.append(f"{path}|True|True")
    command, text = [sys.executable, "-c", ELSEWHERE], "\n".join(lines)
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == expected, done.stderr


@pytest.mark.parametrize(("name", "asked"), [("double_dqn", ()), ("ppo", (Plain,))])
def test_files_go_on_in_either_engine(name, asked, tmp_path):
    model = saved(name, tmp_path, "CartPole-v1", [kind() for kind in asked])
    for engine in ("library", "compiled"):
        env = make_vec_env("CartPole-v1", seed=1)
        loaded = load_algorithm(name).load(tmp_path / "after", env, engine=engine)
        weights = loaded.policy.state_dict(), model.policy.state_dict()
        assert all(map(th.equal, *(each.values() for each in weights)))
        assert steps_of(loaded) == steps_of(model)
        loaded.learn(200, reset_num_timesteps=False)
        assert loaded.num_timesteps >= 500
        assert min(steps_of(loaded)) > max(steps_of(model))

"""Agents that are told what is valid, or that remember: evaluated, continued and played so."""

import io
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from rich.console import Console
from stable_baselines3.common.env_util import make_vec_env

import enjoy
from agents import load_algorithm
from envs.known_models import action_masks_of_states
from envs.wrappers import has_masks
from pipeline.agent_settings import check_fit
from pipeline.environments import make_evaluation_env, make_single_env, make_training_env
from pipeline.errors import UserError
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.policies import has_memory, player, policy_matrix, takes_masks
from pipeline.evaluation.sampled import evaluate
from pipeline.models.choose import ModelRequest, choose_model
from pipeline.playing import play_episodes, playing_env
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train

SMALL = {"n_steps": 32, "batch_size": 32, "n_epochs": 1}
NETWORK = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 10, "buffer_size": 500}
AGENTS = {"dqn": NETWORK, "double_dqn": NETWORK, "ppo_mask": SMALL, "ppo": SMALL}
AGENTS |= {"ppo_lstm": {**SMALL, "policy_kwargs": {"lstm_hidden_size": 8}}}


class Corridor(gym.Env):
    """Six cells in a row, the goal at the right end; what leaves the row is invalid and raises."""

    observation_space = spaces.Discrete(6)
    action_space = spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return self.cell, {}

    def action_masks(self):
        return np.array([self.cell > 0, True, False])

    def step(self, action):
        if not self.action_masks()[action]:
            raise AssertionError(f"action {action} is not valid in cell {self.cell}")
        self.cell += 1 if action == 1 else -1
        return self.cell, -1.0, self.cell == 5, False, {}


class Told(gym.Env):
    """Says by its info alone that only the second of two actions may be done."""

    observation_space = spaces.Box(0, 1, (1,))
    action_space = spaces.Discrete(2)

    @property
    def told(self):
        return {"action_mask": np.array([0, 1], dtype=np.int8)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), self.told

    def step(self, action):
        assert action == 1, "masked"
        return np.zeros(1, np.float32), 1.0, False, False, self.told


@pytest.fixture(scope="module", autouse=True)
def registered():
    gym.register("Corridor-v0", Corridor, max_episode_steps=40)
    gym.register("Told-v0", Told, max_episode_steps=8)
    yield
    del gym.registry["Corridor-v0"], gym.registry["Told-v0"]


def spec_of(algo, env_id="Warehouse-v0", folder=None, fields=(), **entry):
    policy = next(iter(load_algorithm(algo).policy_aliases))
    short = {"env_kwargs": {"max_episode_steps": 30}} if env_id == "Warehouse-v0" else {}
    entry = {"n_timesteps": 64, "policy": policy, **AGENTS.get(algo, {}), **short, **entry}
    common = {"pictures": False, "eval_episodes": 3, "device": "cpu", "log_folder": folder}
    return TrainSpec(algo, env_id, split(entry), entry, seed=0, **{**common, **dict(fields)})


def masked(name, spec, steps=200):
    algorithm = load_algorithm(name)
    policy, env = next(iter(algorithm.policy_aliases)), make_training_env(spec, None)
    return algorithm(policy, env, seed=0, mask_actions=True, **AGENTS.get(name, {})).learn(steps)


def corridors(n_envs):
    return make_vec_env(lambda: gym.make("Corridor-v0"), n_envs, seed=0)


@pytest.fixture
def maskable():
    return load_algorithm("ppo_mask")("MlpPolicy", Corridor(), seed=0, device="cpu", **SMALL)


def train_to(spec):
    """The outcome of a training, and what was printed."""
    out = io.StringIO()
    outcome = train(spec, Console(file=out, width=200), {}, "train.py")
    return outcome, out.getvalue()


# --- masks ---------------------------------------------------------------------------------------


def test_nothing_invalid_is_done_in_training_evaluation_and_play(maskable, tmp_path):
    """The environment raises where a mask is not heeded, which a new policy's draws would not."""
    fields = {"eval_freq": 32}
    outcome, _ = train_to(spec_of("ppo_mask", "Corridor-v0", tmp_path, fields))
    assert outcome.state == "finished"
    assert (outcome.final.is_exact, len(outcome.final.returns)) == (False, 100)
    for n_envs, deterministic in ((1, True), (3, True), (1, False), (3, False)):
        env = corridors(n_envs)
        assert isinstance(player(maskable, env).predict(env.reset())[0], np.ndarray)
        evaluation = evaluate(maskable, env, 6, 0, deterministic)
        # A move costs 1, and five are needed.
        assert (evaluation.returns == -evaluation.lengths).all()
        assert (evaluation.lengths >= 5).all()
    played = list(play_episodes(maskable, corridors(1), 3, deterministic=False))
    assert [length for _, length in played] == [-total for total, _ in played]
    assert len(played) == 3
    with pytest.raises(UserError, match="MaskablePPO has to be told which actions are valid, and"):
        next(play_episodes(maskable, make_vec_env("FrozenLake-v1", 1), 1))
    deaf = load_algorithm("random")("RandomPolicy", Corridor(), seed=0)
    assert player(deaf, corridors(1)) is deaf
    assert not takes_masks(deaf)


def test_an_environment_without_masks_is_refused():
    with pytest.raises(UserError) as caught:
        check_fit(spec_of("ppo_mask", "CartPole-v1"))
    (line,) = str(caught.value).splitlines()
    assert line.startswith(
        "ppo_mask does not fit CartPole-v1: it needs to be told which actions are valid, by a "
        "method action_masks() or by info['action_mask']; fitting agents: semi_gradient_sarsa, "
        "semi_gradient_q, actor_critic, reinforce, dqn, "
    )
    assert "ppo_mask" not in line.partition("fitting agents")[2]
    for env_id in ("CartPole-v1", "FrozenLake-v1"):
        with pytest.raises(UserError, match=f"^mask_actions: {env_id} has no action masks: neith"):
            make_single_env(spec_of("dqn", env_id, mask_actions=True), training=True)


def test_a_masked_policy_is_the_plain_one_on_what_is_valid():
    """Leaving actions out of a softmax divides the others by what they add up to."""
    evaluator = exact_evaluator(spec_of("ppo_mask", "FrozenLake-v1"))
    env = gym.make("FrozenLake-v1")
    agent = load_algorithm("ppo_mask")("MlpPolicy", env, seed=0, device="cpu", **SMALL)
    masks = np.random.default_rng(0).random((16, 4)) < 0.5
    masks[:, 2] |= ~masks.any(axis=1)
    obs = evaluator.observations
    with th.no_grad():
        tensor, _ = agent.policy.obs_to_tensor(obs)
        plain = agent.policy.get_distribution(tensor).distribution.probs.numpy()
    expected = plain * masks / (plain * masks).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(policy_matrix(agent, obs, False, masks), expected, atol=1e-6)
    best = policy_matrix(agent, obs, True, masks)
    assert (best.argmax(axis=1) == expected.argmax(axis=1)).all()
    with pytest.raises(TypeError, match="MaskablePPO: which actions are valid in each state is"):
        policy_matrix(agent, obs, deterministic=True)
    assert evaluator.obstacle(agent) != ""


@pytest.mark.parametrize("name", ["qlearning", "dqn", "double_dqn"])
def test_no_evaluation_does_what_is_masked(name):
    spec = spec_of(name, mask_actions=True)
    agent, evaluator = masked(name, spec), exact_evaluator(spec)
    # A shelf costs 100, the edge of the map 1: what is masked alone can cost more than 30.
    env = make_evaluation_env(spec, 2)
    for deterministic in (True, False):
        policy = policy_matrix(agent, evaluator.observations, deterministic, evaluator.masks)
        assert not policy[~evaluator.masks].any()
        np.testing.assert_allclose(policy.sum(axis=1), 1)
        assert evaluate(agent, env, 6, 0, deterministic).returns.min() >= -30
    played = list(play_episodes(agent, make_evaluation_env(spec, 1), 3))
    assert all(total >= -30 for total, _ in played)
    if name == "dqn":
        sampled = evaluate(agent, make_evaluation_env(spec, 1), 1, 0)
        assert evaluator(agent).mean_return == sampled.mean_return
        untold, _ = agent.predict(evaluator.observations, deterministic=True)
        assert not evaluator.masks[evaluator.observations, untold].all(), "it would do otherwise"
        with pytest.raises(TypeError, match="which actions are valid in each state is not known"):
            policy_matrix(agent, evaluator.observations, True)


@pytest.mark.parametrize("name", ["optimal", "value_iteration"])
def test_planning_under_masks(name):
    # Bumping into the wall on ice is the safe way: masked, it cannot be had.
    env_kwargs = {"slip": 0.6, "desc": ["SM", ".M", ".G"]}
    spec = spec_of(name, "MineMaze-v0", env_kwargs=env_kwargs, mask_actions=True)
    agent, evaluator = masked(name, spec, 1), exact_evaluator(spec)
    chosen = agent.policy.actions_after(evaluator.observations[None], np.arange(100)[:, None])
    masks = action_masks_of_states(make_single_env(spec))
    states = evaluator.model.reachable
    assert masks[np.flatnonzero(states), chosen[:, states]].all()
    # The score's optimum may do anything.
    assert evaluator(agent).mean_return < evaluator.yardstick.optimum - 1


def test_who_is_told():
    env = make_single_env(spec_of("qlearning", mask_actions=True))
    assert "ActionMasks" in str(env)
    assert "ActionMasks" not in str(make_single_env(spec_of("dqn", mask_actions=False)))
    for name, expected in {"qlearning": True, "dqn": True, "optimal": False}.items():
        algorithm = load_algorithm(name)
        policy = next(iter(algorithm.policy_aliases))
        assert takes_masks(algorithm(policy, env, mask_actions=True)) == expected
        assert not takes_masks(algorithm(policy, env))


@pytest.mark.parametrize("env_id", ["Told-v0", "Taxi-v4", "Warehouse-v0"])
def test_masks_are_there_for_one_agent_where_they_are_for_others(env_id):
    assert has_masks(gym.make(env_id))
    for name in ("dqn", "ppo_mask"):
        spec = spec_of(name, env_id, mask_actions=True)
        check_fit(spec)
        assert "<ActionMasks" in str(make_single_env(spec))


def test_an_agent_goes_on_with_its_masks_and_is_played_with_them(tmp_path):
    """Also where the settings of the second training do not say so."""
    fields = {"eval_episodes": 1, "n_eval_envs": 1}
    spec = spec_of("dqn", "Told-v0", tmp_path, fields, mask_actions=True, n_timesteps=40)
    first, _ = train_to(spec)
    entry = {key: value for key, value in spec.saved_hyperparams.items() if key != "mask_actions"}
    silent = replace(spec, hyperparams=split(entry), saved_hyperparams=entry)
    second, _ = train_to(replace(silent, trained_agent=first.run.model_path))
    assert second.final.mean_return == 8
    assert second.run.recorded_spec()["hyperparams"]["mask_actions"] is True
    # A zip that says nothing else of its settings.
    alone = tmp_path / "alone.zip"
    alone.write_bytes(second.run.model_path.read_bytes())
    request = ModelRequest(alone, algo="dqn", env_id="Told-v0", log_folder=tmp_path, device="cpu")
    env = playing_env(choose_model(request), None)
    env.reset()
    assert env.env_method("action_masks")[0].tolist() == [False, True]


# --- memory --------------------------------------------------------------------------------------


class Counting(gym.Env):
    """Rewards the action that is the number of steps done so far; shows nothing."""

    observation_space = spaces.Discrete(1)
    action_space = spaces.Discrete(20)

    def __init__(self, length):
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return 0, {}

    def step(self, action):
        reward = float(action == self.steps)
        self.steps += 1
        return 0, reward, self.steps == self.length, False, {}


class Counter:
    """Acts by how often it was asked since its episode began, which only its state says."""

    num_timesteps = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        state = np.zeros(len(observation), int) if state is None else state
        actions = np.where(episode_start, 0, state)
        return actions, actions + 1


@pytest.mark.parametrize("ends", [[4], [4, 7, 5]])
def test_evaluation_and_play_hand_the_state_on(ends):
    lengths = iter(ends)
    env = make_vec_env(lambda: Counting(next(lengths)), len(ends))
    evaluation = evaluate(Counter(), env, 9, 0)
    assert (evaluation.returns == evaluation.lengths).all()
    assert sorted(set(evaluation.lengths)) == sorted(ends)
    if len(ends) == 1:
        assert list(play_episodes(Counter(), env, 3)) == [(4, 4)] * 3


def test_an_agent_with_a_memory_is_judged_by_episodes_and_says_so(tmp_path, monkeypatch, capsys):
    outcome, printed = train_to(spec_of("ppo_lstm", "FrozenLake-v1", tmp_path))
    assert (outcome.final.is_exact, len(outcome.final.returns)) == (False, 100)
    assert printed.count("evaluations are sampled, not exact: it acts by what it remembers") == 1
    words = ["enjoy.py", "--algo", "ppo_lstm", "--env", "FrozenLake-v1", "-f", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*words, "--no-render", "--n-episodes", "2"])
    assert enjoy.main() == 0
    printed = capsys.readouterr().out
    assert "sampled, not exact: ppo_lstm" in printed
    assert "(exact)" not in printed
    # Asked for every state at once, it would take them for one after another.
    agent = load_algorithm("ppo_lstm")("MlpLstmPolicy", "FrozenLake-v1", device="cpu", **SMALL)
    assert has_memory(agent)
    with pytest.raises(TypeError, match="RecurrentPPO: it acts by what it remembers"):
        policy_matrix(agent, np.arange(16))


def test_other_agents_are_judged_exactly_and_say_nothing(tmp_path):
    outcome, printed = train_to(spec_of("ppo", "FrozenLake-v1", tmp_path))
    assert outcome.final.is_exact
    assert "evaluation:" not in printed

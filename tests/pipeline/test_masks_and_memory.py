"""Agents that are told what is valid, or that remember: evaluated and played as they act."""

import io
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from rich.console import Console
from stable_baselines3.common.env_util import make_vec_env

import enjoy
from agents import load_algorithm
from pipeline.agent_settings import check_fit
from pipeline.errors import UserError
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.policies import has_memory, player, policy_matrix, takes_masks
from pipeline.evaluation.sampled import evaluate
from pipeline.playing import play_episodes
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train

SMALL = {"n_steps": 32, "batch_size": 32, "n_epochs": 1}


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


@pytest.fixture
def corridor():
    gym.register("Corridor-v0", Corridor, max_episode_steps=40)
    yield "Corridor-v0"
    del gym.registry["Corridor-v0"]


def spec_of(algo, env_id, folder=None, **fields):
    policy = next(iter(load_algorithm(algo).policy_aliases))
    entry = {"n_timesteps": 64, "policy": policy, **SMALL}
    if algo == "ppo_lstm":
        entry["policy_kwargs"] = {"lstm_hidden_size": 8}
    fields = {"pictures": False, "eval_episodes": 3, "device": "cpu", **fields}
    return TrainSpec(algo, env_id, split(entry), entry, seed=0, log_folder=folder, **fields)


def train_to(spec):
    """The outcome of a training, and what was printed."""
    out = io.StringIO()
    outcome = train(spec, Console(file=out, width=200), {}, "train.py")
    return outcome, out.getvalue()


# --- masks ---------------------------------------------------------------------------------------


def test_nothing_invalid_is_done_in_training_and_evaluation(corridor, tmp_path):
    """The environment raises where a mask is not heeded, which a new policy's draws would not."""
    outcome, _ = train_to(spec_of("ppo_mask", corridor, tmp_path, eval_freq=32))
    assert outcome.state == "finished"
    assert not outcome.final.is_exact
    assert len(outcome.final.returns) == 100


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_masks_are_heeded_by_the_sampled_evaluation(corridor, deterministic, n_envs):
    agent = load_algorithm("ppo_mask")("MlpPolicy", Corridor(), seed=0, device="cpu", **SMALL)
    env = make_vec_env(lambda: gym.make(corridor), n_envs, seed=0)
    assert isinstance(player(agent, env).predict(env.reset())[0], np.ndarray)
    evaluation = evaluate(agent, env, 6, 0, deterministic)
    # A move costs 1, and five are needed.
    assert (evaluation.returns == -evaluation.lengths).all()
    assert (evaluation.lengths >= 5).all()


def test_masks_are_heeded_in_play(corridor):
    agent = load_algorithm("ppo_mask")("MlpPolicy", Corridor(), seed=0, device="cpu", **SMALL)
    env = make_vec_env(lambda: gym.make(corridor), 1, seed=0)
    played = list(play_episodes(agent, env, 3, deterministic=False))
    assert [length for _, length in played] == [-total for total, _ in played]
    assert len(played) == 3


def test_masks_that_are_not_there_are_missed_in_one_line():
    agent = load_algorithm("ppo_mask")("MlpPolicy", Corridor(), seed=0, device="cpu", **SMALL)
    with pytest.raises(UserError, match="MaskablePPO has to be told which actions are valid, and"):
        next(play_episodes(agent, make_vec_env("FrozenLake-v1", 1), 1))


def test_an_agent_that_does_not_listen_is_asked_as_ever(corridor):
    agent = load_algorithm("random")("RandomPolicy", Corridor(), seed=0)
    env = make_vec_env(lambda: gym.make(corridor), 1)
    assert player(agent, env) is agent
    assert not takes_masks(agent)


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


def uneven(n_envs):
    """Environments whose episodes end at different times."""
    lengths = iter([4, 7, 5])
    return make_vec_env(lambda: Counting(next(lengths)), n_envs)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_the_sampled_evaluation_hands_the_state_on(n_envs):
    evaluation = evaluate(Counter(), uneven(n_envs), 9, 0)
    assert (evaluation.returns == evaluation.lengths).all()
    assert sorted(set(evaluation.lengths)) == ([4] if n_envs == 1 else [4, 5, 7])


def test_play_hands_the_state_on():
    assert list(play_episodes(Counter(), uneven(1), 3)) == [(4, 4)] * 3


def test_an_agent_with_a_memory_is_judged_by_episodes_and_says_so(tmp_path, monkeypatch, capsys):
    outcome, printed = train_to(spec_of("ppo_lstm", "FrozenLake-v1", tmp_path))
    assert not outcome.final.is_exact
    assert len(outcome.final.returns) == 100
    assert printed.count("evaluations are sampled, not exact: it acts by what it remembers") == 1
    words = ["enjoy.py", "--algo", "ppo_lstm", "--env", "FrozenLake-v1", "-f", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*words, "--no-render", "--n-episodes", "2"])
    assert enjoy.main() == 0
    printed = capsys.readouterr().out
    assert "sampled, not exact: ppo_lstm" in printed
    assert "(exact)" not in printed
    # Asked for every state at once, it would take them for one after another.
    algorithm = load_algorithm("ppo_lstm")
    agent = algorithm("MlpLstmPolicy", "FrozenLake-v1", device="cpu", **SMALL)
    assert has_memory(agent)
    with pytest.raises(TypeError, match="RecurrentPPO: it acts by what it remembers"):
        policy_matrix(agent, np.arange(16))


def test_other_agents_are_judged_exactly_and_say_nothing(tmp_path):
    outcome, printed = train_to(spec_of("ppo", "FrozenLake-v1", tmp_path))
    assert outcome.final.is_exact
    assert "evaluation:" not in printed

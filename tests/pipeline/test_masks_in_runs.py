"""Runs with action masks: evaluation and playing tell agents what the environment allows."""

import io
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from rich.console import Console

from agents import load_algorithm
from envs.known_models import action_masks_of_states
from envs.wrappers import has_masks
from pipeline.agent_settings import check_fit
from pipeline.environments import make_evaluation_env, make_single_env, make_training_env
from pipeline.errors import UserError
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.policies import policy_matrix, takes_masks
from pipeline.evaluation.sampled import evaluate
from pipeline.models.choose import ModelRequest, choose_model
from pipeline.playing import play_episodes, playing_env
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train

SMALL = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 10, "buffer_size": 500}
AGENTS = {"qlearning": {}, "dqn": SMALL, "double_dqn": SMALL, "optimal": {}, "value_iteration": {}}


def spec_of(name, env_id="Warehouse-v0", **entry):
    entry = {
        "n_timesteps": 1,
        "mask_actions": True,
        "env_kwargs": {"max_episode_steps": 30},
    } | entry
    return TrainSpec(name, env_id, split(entry), entry, seed=0)


def trained(name, spec, steps=200):
    algorithm = load_algorithm(name)
    policy = next(iter(algorithm.policy_aliases))
    env = make_training_env(spec, None)
    return algorithm(policy, env, seed=0, mask_actions=True, **AGENTS[name]).learn(steps)


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("name", ["qlearning", "dqn", "double_dqn"])
def test_no_evaluation_does_what_is_masked(name, deterministic):
    spec = spec_of(name)
    agent, evaluator = trained(name, spec), exact_evaluator(spec)
    policy = policy_matrix(agent, evaluator.observations, deterministic, evaluator.masks)
    assert not policy[~evaluator.masks].any()
    np.testing.assert_allclose(policy.sum(axis=1), 1)
    # A shelf costs 100, the edge of the map 1: what is masked alone can cost more than 30.
    env = make_evaluation_env(spec, 2)
    assert evaluate(agent, env, 6, 0, deterministic).returns.min() >= -30
    played = list(play_episodes(agent, env.__class__([lambda: env.envs[0]]), 3))
    assert all(total >= -30 for total, _ in played)


def test_exact_and_sampled_evaluation_agree():
    spec = spec_of("dqn")
    agent, env = trained("dqn", spec), make_evaluation_env(spec, 1)
    evaluator = exact_evaluator(spec)
    assert evaluator(agent).mean_return == evaluate(agent, env, 1, 0).mean_return
    told = policy_matrix(agent, evaluator.observations, True, evaluator.masks)
    untold, _ = agent.predict(evaluator.observations, deterministic=True)
    assert not evaluator.masks[evaluator.observations, untold].all(), "it would do what is masked"
    with pytest.raises(TypeError, match="which actions are valid in each state is not known"):
        policy_matrix(agent, evaluator.observations, True)
    assert not told[~evaluator.masks].any()


@pytest.mark.parametrize("name", ["optimal", "value_iteration"])
def test_planning_under_masks(name):
    # Bumping into the wall on ice is the safe way: masked, it cannot be had.
    entry = {"env_kwargs": {"slip": 0.6, "desc": ["SM", ".M", ".G"]}}
    spec = spec_of(name, "MineMaze-v0", **entry)
    agent, evaluator = trained(name, spec, 1), exact_evaluator(spec)
    chosen = agent.policy.actions_after(evaluator.observations[None], np.arange(100)[:, None])
    masks = action_masks_of_states(make_single_env(spec))
    states = evaluator.model.reachable
    assert masks[np.flatnonzero(states), chosen[:, states]].all()
    # The score's optimum may do anything.
    assert evaluator(agent).mean_return < evaluator.yardstick.optimum - 1


def test_who_is_told():
    env = make_single_env(spec_of("qlearning"))
    told = {"qlearning": True, "dqn": True, "optimal": False}
    for name, expected in told.items():
        algorithm = load_algorithm(name)
        policy = next(iter(algorithm.policy_aliases))
        assert takes_masks(algorithm(policy, env, mask_actions=True)) == expected
        assert not takes_masks(algorithm(policy, env))


@pytest.mark.parametrize("env_id", ["CartPole-v1", "FrozenLake-v1"])
def test_an_environment_without_masks_is_refused_before_anything_is_made(env_id):
    with pytest.raises(UserError, match=f"^mask_actions: {env_id} has no action masks: neither"):
        make_single_env(spec_of("dqn", env_id, env_kwargs={}), training=True)


def test_without_the_setting_environments_are_as_they_were():
    spec = spec_of("dqn", mask_actions=False)
    assert "ActionMasks" not in str(make_single_env(spec))
    assert "ActionMasks" in str(make_single_env(spec_of("dqn")))


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


@pytest.fixture
def told(monkeypatch):
    entry = gym.envs.registration.EnvSpec("Told-v0", Told, max_episode_steps=8)
    monkeypatch.setitem(gym.registry, "Told-v0", entry)
    return "Told-v0"


@pytest.mark.parametrize("env_id", ["Told-v0", "Taxi-v4", "Warehouse-v0"])
def test_masks_are_there_for_one_agent_where_they_are_for_others(told, env_id):
    assert has_masks(gym.make(env_id))
    for name in ("dqn", "ppo_mask"):
        spec = spec_of(name, env_id, mask_actions=True)
        check_fit(spec)
        assert "<ActionMasks" in str(make_single_env(spec))


def test_an_agent_goes_on_with_its_masks_and_is_played_with_them(told, tmp_path):
    """Also where the settings of the second training do not say so."""
    entry = {"n_timesteps": 40, "learning_starts": 8, "policy_kwargs": {"net_arch": [4]}}
    masked = TrainSpec(
        "dqn",
        told,
        split({**entry, "mask_actions": True}),
        {**entry, "mask_actions": True},
        seed=0,
        log_folder=tmp_path,
        pictures=False,
        eval_episodes=1,
        n_eval_envs=1,
        device="cpu",
    )
    console = Console(file=io.StringIO())
    first = train(masked, console, {}, "train.py")
    zip_path = first.run.model_path
    silent = replace(
        masked, hyperparams=split(entry), saved_hyperparams=entry, trained_agent=zip_path
    )
    second = train(silent, console, {}, "train.py")
    assert second.final.mean_return == 8
    assert second.run.recorded_spec()["hyperparams"]["mask_actions"] is True
    # A zip that says nothing else of its settings.
    alone = tmp_path / "alone.zip"
    alone.write_bytes(second.run.model_path.read_bytes())
    request = ModelRequest(path=alone, algo="dqn", env_id=told, log_folder=tmp_path, device="cpu")
    env = playing_env(choose_model(request), None)
    env.reset()
    assert env.env_method("action_masks")[0].tolist() == [False, True]

"""Runs with action masks: evaluation and playing tell agents what the environment allows."""

import numpy as np
import pytest

from agents import load_algorithm
from envs.known_models import action_masks_of_states
from pipeline.environments import make_evaluation_env, make_single_env, make_training_env
from pipeline.errors import UserError
from pipeline.evaluation.exact import exact_evaluator, policy_matrix
from pipeline.evaluation.mask_telling import takes_masks
from pipeline.evaluation.sampled import evaluate
from pipeline.playing import play_episodes
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec

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
    policy = evaluator.policy(agent, deterministic)
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
    untold = policy_matrix(agent, evaluator.observations, True)
    assert untold[~evaluator.masks].any(), "this network would do what is masked"
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

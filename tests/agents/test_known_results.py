"""What is known exactly, or from books: plans, cliffs, deep seas."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from rl_yardstick import mdp
from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import EpisodeBudget
from rl_yardstick.envs.known_models import time_limit, transition_model
from tests.mdp.test_random_models import deterministic

N_SEEDS = 10


def made(name, env_id, seed=0, n_envs=1, env_kwargs=None, **settings):
    env = make_vec_env(env_id, n_envs, seed=seed, env_kwargs=env_kwargs)
    return load_algorithm(name)(env=env, seed=seed, **settings)


def test_policy_iteration_by_hand():
    """To stay in state 0 earns 1, in state 1 it earns 3; to go over earns nothing."""
    model = deterministic([[0, 1], [1, 1]], [[1, 0], [3, 3]], np.zeros((2, 2)))
    plan = mdp.policy_iteration(model, 0.5)
    assert plan.values == pytest.approx([3, 6])
    assert plan.action_values[0] == pytest.approx([2.5, 3])
    assert (plan.policy[0], plan.iterations) == (1, 2)


def test_the_optimal_agent_keeps_the_time_of_each_episode_apart():
    agent = made("optimal", "FrozenLake-v1").learn(1)
    plan = mdp.finite_horizon_optimum(transition_model(gym.make("FrozenLake-v1")), 100)
    # A state whose best action changes towards the end of the time.
    changing = np.flatnonzero((plan.policy != plan.policy[0]).any(axis=0))[0]
    state = None
    for step in range(100):
        # The second episode begins anew at each call.
        starts = np.array([step == 0, True])
        actions, state = agent.predict(np.array([changing, changing]), state, starts)
        assert actions.tolist() == [plan.policy[step][changing], plan.policy[0][changing]]
    agent = made("optimal", "Warehouse-v0").learn(220)
    assert [episode["r"] for episode in agent.ep_info_buffer] == [79.0] * 10
    assert evaluate_policy(agent, agent.env, 3)[0] == 79


def test_plans_need_a_model_and_the_optimum_a_time_limit():
    changes = {"maze": "blocking", "changed": True, "change_after_steps": 9}
    unknown = gym.make("DynaMaze-v0", **changes)
    with pytest.raises(ValueError, match="transition model is known"):
        load_algorithm("value_iteration")(env=unknown).learn(1)
    with pytest.raises(ValueError, match="needs a time limit"):
        load_algorithm("optimal")(env=gym.make("CliffWalking-v1")).learn(1)


def worth(agent, env_id, kwargs, horizon=None):
    """What the greedy policy earns, and what the best one does, exactly."""
    env = gym.make(env_id, **kwargs)
    model, horizon = transition_model(env), horizon or time_limit(env)
    policy = agent.predict(np.arange(model.n_states), deterministic=True)[0]
    optimum = mdp.finite_horizon_optimum(model, horizon).start_value
    return mdp.policy_return(model, policy, horizon).expected_return, optimum


def test_cliff_walking_as_in_the_book():
    """Sutton and Barto, example 6.6: epsilon 0.1, step size 0.1, undiscounted, 500 episodes."""
    settings = {"learning_rate": 0.1, "gamma": 1.0, "exploration_initial_eps": 0.1}
    settings["exploration_decay"] = "constant"
    found, online = {}, {}
    for name in ("qlearning", "sarsa"):
        agents = [made(name, "CliffWalking-v1", seed, **settings) for seed in range(N_SEEDS)]
        for agent in agents:
            agent.learn(10**9, callback=EpisodeBudget(2000), log_interval=None)
        found[name] = [worth(agent, "CliffWalking-v1", {}, 200)[0] for agent in agents]
        envs = [agent.env.envs[0] for agent in agents]
        returns = [env.get_wrapper_attr("get_episode_rewards")() for env in envs]
        online[name] = [np.mean(each[-1000:]) for each in returns]
    assert found["qlearning"] == [-13] * N_SEEDS
    assert all(-17 <= value <= -15 for value in found["sarsa"])
    # While learning it is the other way round, on every seed.
    assert all(s > q for s, q in zip(online["sarsa"], online["qlearning"], strict=True))
    assert -59 < np.mean(online["qlearning"]) < -47
    assert -28 < np.mean(online["sarsa"]) < -20


@pytest.mark.parametrize(
    ("env_id", "kwargs", "bound"), [("DeepSea-v0", {"size": 10}, 1.0), ("RiverSwim-v0", {}, 100.0)]
)
def test_it_finds_what_epsilon_greedy_never_sees(env_id, kwargs, bound):
    """On each of ten seeds the optimum, and next to nothing.

    Where time is short one would not swim on at the end, which is worth .02 % and no table can say.
    """
    for seed in range(N_SEEDS):
        optimist = made("qlearning_ucb", env_id, seed, 1, kwargs, value_bound=bound)
        found, optimum = worth(optimist.learn(10_000), env_id, kwargs)
        assert found == pytest.approx(optimum, rel=3e-4)
        greedy = made("qlearning", env_id, seed, 1, kwargs).learn(10_000)
        assert worth(greedy, env_id, kwargs)[0] < 0.04 * optimum

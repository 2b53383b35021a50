"""What `--diagnose` compares, by hand, by finite differences and by many rollouts."""

from dataclasses import replace

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv

from rl_yardstick.agents.policies import own_values, policy_matrix
from rl_yardstick.mdp import TransitionModel, policy_return, state_visitation
from rl_yardstick.mdp.gaps import expected_estimates
from rl_yardstick.pipeline.environments import make_training_env
from rl_yardstick.pipeline.evaluation import critics
from tests.agents.hand_fed import Spaces
from tests.pipeline.short_runs import LAKE, agent_of, spec_of


def chain_world():
    """0 goes on to 1 for a reward of 1, 1 to the end for 2; action 1 stays, for nothing."""
    following = np.array([[[1], [0]], [[1], [1]]])
    reward = np.array([[[1.0], [0.0]], [[2.0], [0.0]]])
    ends = np.array([[[False], [False]], [[True], [False]]])
    model = TransitionModel(np.ones((2, 2, 1)), following, reward, ends, np.array([1.0, 0.0]))
    return critics.KnownWorld(model, np.arange(2), horizon=4, masks=None)


def two_states():
    return DummyVecEnv([lambda: Spaces(2, 2)])


def compared(algo, table, *, explores, **arguments):
    agent = agent_of(algo, two_states(), gamma=0.5, **arguments)
    agent.policy.q_tables[:] = th.tensor(table, dtype=th.float64)
    recorder = critics.CriticRecorder(None, chain_world(), explores=explores)
    recorder.model = agent
    return recorder.figures()


def test_errors_of_a_greedy_table_worked_out_by_hand():
    # Greedy it goes on twice: V = (2, 2), Q = ((2, 1), (2, 1)), and is half of its steps in each.
    found = compared("qlearning", [[3.0, 1.0], [2.0, 2.0]], explores=False)
    # Errors of Q: 1, 0, 0, 1; own advantages (0, -2), (0, 0), exact ones (0, -1) twice.
    assert found.pop("overestimation") == pytest.approx(0.5)
    names = {f"{name}_error{part}" for name in ("v", "q", "advantage") for part in ("", "_visited")}
    assert found == pytest.approx(dict.fromkeys(names, np.sqrt(1 / 2)))
    # It stays in 0 for ever, which is worth nothing, and believes that this is worth 4.
    found = compared("qlearning", [[3.0, 4.0], [2.0, 1.0]], explores=False)
    assert found["overestimation"] == found["v_error_visited"] == pytest.approx(4.0)
    assert found["v_error"] == pytest.approx(np.sqrt((4**2 + 0) / 2))
    # Q(0) = (1 + 1/2 2, 0).
    assert found["q_error_visited"] == pytest.approx(np.sqrt((1 + 16) / 2))
    assert found["q_error"] == pytest.approx(np.sqrt((1 + 16 + 0 + 0) / 4))


def test_sarsa_is_compared_with_the_policy_that_explores():
    # Random: V = (10/9, 4/3), Q = ((5/3, 5/9), (2, 2/3)), see the tests of advantages.
    right = [[5 / 3, 5 / 9], [2.0, 2 / 3]]
    found = compared("sarsa", right, explores=True, exploration_initial_eps=1.0)
    errors = {name: value for name, value in found.items() if name != "entropy"}
    assert errors == pytest.approx(dict.fromkeys(errors, 0.0), abs=1e-12)
    assert "overestimation" not in errors
    assert found["entropy"] == pytest.approx(np.log(2))
    assert compared("qlearning", right, explores=False)["overestimation"] < -0.1


def test_which_policy_an_agent_s_values_are_of():
    follows = {"sarsa", "expected_sarsa", "n_step_sarsa", "sarsa_lambda", "monte_carlo"}
    follows |= {"n_step_tree_backup", "semi_gradient_sarsa", "actor_critic", "ppo", "a2c"}
    maximises = {"qlearning", "double_qlearning", "q_lambda", "dyna_q", "dqn", "double_dqn"}
    maximises |= {"off_policy_monte_carlo", "prioritized_sweeping", "semi_gradient_q"}
    for algo in follows | maximises:
        spec = spec_of(algo, LAKE)
        agent = agent_of(algo, make_training_env(spec, None))
        recorder = critics.recorder_of(None, spec, agent)
        assert recorder.explores == (algo in follows), algo
        recorder.model = agent
        assert np.isfinite(recorder.figures()["v_error"]), algo


def on_ice(**settings):
    """An agent on a lake of four cells, what is known of it, and the recorder of its rollouts."""
    small = {"desc": ["SF", "FG"], "max_episode_steps": 8}
    spec = spec_of("ppo", LAKE, {"n_envs": 4, "env_kwargs": small})
    settings = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 256, "gamma": 0.9, **settings}
    agent = agent_of("ppo", make_training_env(spec, None), device="cpu", **settings)
    recorder = critics.RolloutRecorder(None, critics.known_world(spec, agent), explores=True)
    recorder.model = agent
    return agent, recorder.world, recorder


def collect(agent):
    """A rollout of an agent that does not learn from it."""
    _, callback = agent._setup_learn(10**9, CallbackList([]))
    agent.collect_rollouts(agent.env, callback, agent.rollout_buffer, agent.n_steps)
    return agent.rollout_buffer


def steps_left(episode_starts, limit):
    """Of how many TD errors an estimate is at most the sum, by step and environment."""
    n_steps, n_envs = episode_starts.shape
    left, ages = np.zeros((n_steps, n_envs), np.int64), np.zeros(n_envs, np.int64)
    for step, starts in enumerate(episode_starts):
        ages[starts > 0] = 0
        left[step] = np.minimum(n_steps - step, limit - ages)
        ages += 1
    return left


def test_estimates_of_rollouts_are_compared_with_what_is_expected_of_them():
    agent, world, recorder = on_ice(gae_lambda=0.7, engine="library")
    buffer = collect(agent)
    found = recorder.rollout_figures(0)
    states = buffer.observations.reshape(-1).astype(int)
    actions = buffer.actions.reshape(-1).astype(int)
    policy, critic = recorder.policy(), own_values(agent, world.observations)
    advantages = world.values(policy, 0.9).advantages[states, actions]
    steps = states, actions, steps_left(buffer.episode_starts, 8).reshape(-1)
    expected, shared = expected_estimates(world.model, policy, critic, 0.9, 0.7, steps)
    for name, errors in (
        ("gae_bias", expected - shared - advantages),
        ("gae_offset", shared),
        ("gae_std", buffer.advantages.reshape(-1) - expected),
    ):
        assert found[name] == pytest.approx(np.sqrt((errors**2).mean())), name
    # Nothing but chance is left: the mean error of so many is small beside one error.
    assert abs((buffer.advantages.reshape(-1) - expected).mean()) < 0.3 * found["gae_std"]


def test_the_exact_gradient_is_that_of_finite_differences():
    """Of the return, where neither discount nor time limit makes a difference."""
    chain = chain_world()
    reward = chain.model.reward - np.array([0.0, 1.0])[:, None]  # to stay costs 1
    world = replace(chain, model=replace(chain.model, reward=reward), horizon=400)
    settings = {"policy_kwargs": {"net_arch": [3]}, "gamma": 1.0, "n_steps": 8, "batch_size": 8}
    agent = agent_of("ppo", two_states(), device="cpu", **settings)
    agent.policy.double()
    actor = agent.policy.mlp_extractor.forward_actor
    agent.policy.mlp_extractor.forward_actor = lambda features: actor(features.double())
    policy = policy_matrix(agent, world.observations, deterministic=False)
    visits = state_visitation(world.model, policy, 400)
    weights = (visits[:, None] * policy * world.values(policy, 1.0).advantages)[None]
    (found,) = critics._gradients(agent.policy, world, np.arange(2), weights)

    def value():
        now = policy_matrix(agent, world.observations, deterministic=False)
        return policy_return(world.model, now, 400).expected_return

    slopes = []
    with th.no_grad():
        for name, parameter in agent.policy.named_parameters():
            if name.startswith(("mlp_extractor.value_net", "value_net")):
                continue
            flat = parameter.view(-1)
            for i in range(len(flat)):
                flat[i] += 1e-5
                up = value()
                flat[i] -= 2e-5
                slopes.append((up - value()) / 2e-5)
                flat[i] += 1e-5
    assert np.linalg.norm(slopes) > 0.1
    assert found == pytest.approx(slopes, abs=1e-6)


def test_the_gradient_of_a_minibatch_is_the_one_that_the_library_descends():
    """At ratio 1 and without other terms, but for the scale of normalised advantages."""
    agent, world, _ = on_ice(batch_size=1024, engine="library")
    buffer = collect(agent)
    estimates = buffer.advantages.reshape(-1).astype(np.float64)
    ((steps, centred),) = critics.minibatches(agent, estimates, 0)
    assert sorted(steps) == list(range(1024))
    assert centred.mean() == pytest.approx(0.0, abs=1e-9)
    agent.batch_size = 205  # of which 1024 steps are five but for one
    assert [len(batch) for batch, _ in critics.minibatches(agent, estimates, 0)] == [205] * 4
    states = world.states_of(buffer.observations, 1024)
    weights, actions = np.zeros((1, 4, 4)), buffer.actions.reshape(-1).astype(int)
    np.add.at(weights[0], (states[steps], actions[steps]), centred / 1024)
    (ours,) = critics._gradients(agent.policy, world, np.arange(4), weights)
    (batch,) = list(buffer.get(1024))
    _, log_prob, _ = agent.policy.evaluate_actions(batch.observations, batch.actions.flatten())
    advantages = (batch.advantages - batch.advantages.mean()) / (batch.advantages.std() + 1e-8)
    ratio = th.exp(log_prob - batch.old_log_prob)
    gain = th.min(advantages * ratio, advantages * th.clamp(ratio, 0.8, 1.2)).mean()
    slopes = th.autograd.grad(gain, list(agent.policy.parameters()), allow_unused=True)
    theirs = th.cat([slope.reshape(-1) for slope in slopes if slope is not None])
    theirs = theirs.double().numpy() * float(estimates.std(ddof=1))
    assert np.linalg.norm(theirs) > 1e-3
    assert ours == pytest.approx(theirs, abs=1e-5)


def test_cosine_and_signal_to_noise_of_multiples_of_the_exact_gradient():
    """Twice the gradient errs by the gradient, its opposite by twice the gradient."""
    _, _, recorder = on_ice()
    true = np.random.default_rng(0).normal(size=(4, 4)) / 10
    states, actions, steps = np.repeat(np.arange(4), 4), np.tile(np.arange(4), 4), np.arange(16)
    for multiples, cosine, ratio in (
        *(((2,), 1, 1), ((-1,), -1, 1 / 4), ((2, -1), 0, 1 / 2.5)),
        ((2, 0), 1, 1),  # a gradient of zero has no direction
    ):
        batches = [(steps, 16 * multiple * true.reshape(-1)) for multiple in multiples]
        found = recorder.gradient_figures(true, states, actions, batches)
        assert found["gradient_cosine"] == pytest.approx(cosine, abs=1e-4)
        assert found["gradient_snr"] == pytest.approx(ratio, rel=1e-3)


def test_where_states_look_alike_values_are_compared_and_rollouts_are_not():
    spec = spec_of("ppo", "ShortCorridor-v0")
    agent = agent_of("ppo", make_training_env(spec, None), device="cpu")
    recorder = critics.recorder_of(None, spec, agent)
    assert type(recorder) is critics.CriticRecorder
    recorder.model = agent
    assert set(recorder.figures()) == {"v_error", "v_error_visited", "entropy"}

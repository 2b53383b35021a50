"""The textbook's environments against what the books print, closed forms, and rules by hand."""

import gymnasium as gym
import numpy as np
import pytest

import envs  # noqa: F401 (registers the environments)
from agents import load_algorithm
from agents.compiled.engine import choose_engine
from envs.finite_env import first_above, summing_to_one
from envs.known_models import action_masks_of_states, success_outcomes, time_limit, transition_model
from envs.textbook.windy_gridworld import WindyGridworldEnv
from mdp import (
    TransitionModel,
    finite_horizon_optimum,
    policy_iteration,
    policy_return,
    state_values,
    value_iteration,
)

LIMITS = {
    "DeepSea-v0": 1000,
    "DynaMaze-v0": 100,
    "GamblersProblem-v0": 1000,
    "JacksCarRental-v0": 100,
    "MaximizationBias-v0": 100,
    "Racetrack-v0": 1000,
    "RandomWalk-v0": 1000,
    "RiverSwim-v0": 20,
    "ShortCorridor-v0": 1000,
    "WindyGridworld-v0": 1000,
}


def model_of(env_id: str, **kwargs) -> TransitionModel:
    model = transition_model(gym.make(env_id, **kwargs))
    assert model is not None
    return model


def optimum_of(env_id: str, **kwargs) -> float:
    return finite_horizon_optimum(model_of(env_id, **kwargs), LIMITS[env_id]).start_value


def optimal_values(env_id: str, discount=1.0, **kwargs) -> np.ndarray:
    return policy_iteration(model_of(env_id, **kwargs), discount).values


def walk(env, actions):
    """States and rewards of a walk, and whether its last step terminated."""
    steps = [env.step(action)[:3] for action in actions]
    return [step[0] for step in steps], [step[1] for step in steps], steps[-1][2]


def test_time_limits() -> None:
    assert {env_id: time_limit(gym.make(env_id)) for env_id in LIMITS} == LIMITS


# --- RandomWalk ----------------------------------------------------------------------------------


def test_values_of_the_walk_of_five_states_are_those_of_example_6_2() -> None:
    values = optimal_values("RandomWalk-v0")
    np.testing.assert_allclose(values[1:6], np.arange(1, 6) / 6, atol=1e-9)


def test_values_of_the_walk_of_nineteen_states_are_those_of_example_7_1() -> None:
    values = optimal_values("RandomWalk-v0", n_states=19, left_reward=-1)
    np.testing.assert_allclose(values[1:20], np.arange(-18, 19, 2) / 20, atol=1e-9)


def test_the_walk_of_a_thousand_states_is_example_9_1() -> None:
    kwargs = {"n_states": 1000, "max_jump": 100, "left_reward": -1}
    model = model_of("RandomWalk-v0", **kwargs)
    # From state 1, one jump to the left in two leads beyond the end.
    assert model.prob[1, 0][model.next_state[1, 0] == 0].sum() == pytest.approx(0.5)
    assert model.prob[31, 0][model.next_state[31, 0] == 0].sum() == pytest.approx(70 / 200)
    assert sorted(set(model.next_state[500, 0].tolist())) == [*range(400, 500), *range(501, 601)]
    values = optimal_values("RandomWalk-v0", **kwargs)[1:1001]
    np.testing.assert_allclose(values, -values[::-1], atol=1e-9)
    # The linear system by itself: each value is the mean of what 200 jumps lead to.
    padded = np.concatenate([[-1.0] * 100, values, [1.0] * 100])
    windows = np.lib.stride_tricks.sliding_window_view(padded, 201).sum(axis=1)
    np.testing.assert_allclose(values, (windows - values) / 200, atol=1e-9)
    assert (np.diff(values) > 0).all()


def test_all_agents_earn_the_same_on_a_walk() -> None:
    assert gym.make("RandomWalk-v0").action_space.n == 1
    assert optimum_of("RandomWalk-v0") == pytest.approx(0.5)


# --- WindyGridworld ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "steps"),
    [({}, 15), ({"moves": "king"}, 7), ({"moves": "king_and_stay"}, 7)],
)
def test_the_shortest_ways_through_the_wind(kwargs, steps) -> None:
    assert optimum_of("WindyGridworld-v0", **kwargs) == -steps


def test_the_way_that_example_6_5_shows() -> None:
    env = gym.make("WindyGridworld-v0").unwrapped
    env.reset(seed=0)
    right, down, left = 3, 1, 2
    states, rewards, terminated = walk(env, [right] * 9 + [down] * 4 + [left] * 2)
    assert states[:9] == [31, 32, 33, 24, 15, 6, 7, 8, 9]
    assert states[9:] == [19, 29, 39, 49, 48, 37]
    assert (rewards, terminated) == ([-1.0] * 15, True)


def next_by_hand(state: int, down: int, right: int, gust: int) -> int:
    """A step as the book describes it, written out once more."""
    wind = [0, 0, 0, 1, 1, 1, 2, 2, 1, 0]
    row, column = state // 10, state % 10
    if wind[column]:
        row -= wind[column] + gust
    return 10 * min(max(row + down, 0), 6) + min(max(column + right, 0), 9)


def test_every_step_in_a_wind_that_varies() -> None:
    env = WindyGridworldEnv("king_and_stay", stochastic=True)
    model = env.transition_model()
    moves = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1), (0, 0)]
    assert model.n_actions == 9
    for state in set(range(70)) - {37}:
        for action, move in enumerate(moves):
            chances = np.zeros(70)
            np.add.at(chances, model.next_state[state, action], model.prob[state, action])
            by_hand = np.zeros(70)
            for gust in (-1, 0, 1):
                by_hand[next_by_hand(state, *move, gust)] += 1 / 3
            np.testing.assert_allclose(chances, by_hand, atol=1e-15)
    assert (model.reward[np.arange(70) != 37] == -1).all()


# --- GamblersProblem -----------------------------------------------------------------------------


def test_values_of_the_gambler_are_those_of_bold_play() -> None:
    values = optimal_values("GamblersProblem-v0")
    # Dubins and Savage (1965): staking all that may be staked is optimal on an unfair coin.
    bold = np.zeros(101)
    bold[100] = 1
    for _ in range(200):
        for capital in range(1, 100):
            stake = min(capital, 100 - capital)
            bold[capital] = 0.4 * bold[capital + stake] + 0.6 * bold[capital - stake]
    np.testing.assert_allclose(values[1:100], bold[1:100], atol=1e-9)
    assert values[50] == pytest.approx(0.4, abs=1e-12)
    assert values[25] == pytest.approx(0.16, abs=1e-12)
    assert values[75] == pytest.approx(0.4 + 0.6 * 0.4, abs=1e-12)


def test_on_a_kind_coin_the_gambler_is_timid() -> None:
    values = optimal_values("GamblersProblem-v0", heads_probability=0.6, goal=10)
    ratio = 0.4 / 0.6
    ruin = (1 - ratio ** np.arange(1, 10)) / (1 - ratio**10)
    np.testing.assert_allclose(values[1:10], ruin, atol=1e-9)


def test_a_stake_that_is_too_large_is_not_taken() -> None:
    env = gym.make("GamblersProblem-v0", start_capital=30).unwrapped
    for action, after in ((31, {30}), (0, {30}), (30, {0, 60})):
        states = set()
        for seed in range(20):
            env.reset(seed=seed)
            states.add(env.step(action)[0])
        assert states == after
    masks = action_masks_of_states(env)
    assert masks[30].tolist() == [True] * 31 + [False] * 20
    assert masks[90].sum() == 11
    env.s = 99
    assert env.action_masks().tolist() == [True, True] + [False] * 49


def test_starts_of_the_gambler() -> None:
    initial = gym.make("GamblersProblem-v0").unwrapped.initial_state_distrib
    np.testing.assert_allclose(initial[1:100], 1 / 99)
    assert gym.make("GamblersProblem-v0", start_capital=7).reset()[0] == 7
    assert optimum_of("GamblersProblem-v0", start_capital=25) == pytest.approx(0.16)


def test_reaching_the_goal_is_success() -> None:
    env = gym.make("GamblersProblem-v0")
    success = success_outcomes(env)
    assert (transition_model(env).next_state[success] == 100).all()
    assert success[50, 50].tolist() == [True, False]


# --- MaximizationBias ----------------------------------------------------------------------------


def test_right_is_the_optimum_of_maximization_bias() -> None:
    model = model_of("MaximizationBias-v0")
    plan = value_iteration(model, 1.0)
    assert plan.policy[2] == 1
    assert optimum_of("MaximizationBias-v0") == 0.0
    left, right = np.zeros(4, int), np.ones(4, int)
    returns = [policy_return(model, policy, 100) for policy in (left, right)]
    assert [result.expected_return for result in returns] == [-0.1, 0.0]
    assert [result.return_variance for result in returns] == [1.0, 0.0]
    assert [result.expected_length for result in returns] == [2.0, 1.0]


def test_rewards_after_left_are_normal_around_a_small_loss() -> None:
    env = gym.make("MaximizationBias-v0").unwrapped
    env.reset(seed=1)
    rewards = []
    for i in range(20_000):
        assert env.reset()[0] == 2
        assert env.step(0)[:3] == (1, 0.0, False)
        state, reward, terminated, _, _ = env.step(i % 10)
        assert (state, terminated) == (0, True)
        rewards.append(reward)
    # Four standard errors of the mean, and of the standard deviation.
    assert np.mean(rewards) == pytest.approx(-0.1, abs=4 / np.sqrt(20_000))
    assert np.std(rewards) == pytest.approx(1, abs=4 / np.sqrt(2 * 20_000))


def test_in_a_two_actions_are_allowed_and_others_repeat_them() -> None:
    env = gym.make("MaximizationBias-v0", n_actions=5).unwrapped
    env.reset(seed=0)
    assert env.action_masks().tolist() == [True, True, False, False, False]
    assert env.transition_model().next_state[2, :, 0].tolist() == [1, 3, 1, 3, 1]
    env.step(0)
    assert env.action_masks().all()


# --- RiverSwim -----------------------------------------------------------------------------------


def test_swimming_right_for_ever_is_optimal_and_earns_what_its_chain_says() -> None:
    model = model_of("RiverSwim-v0")
    plan = value_iteration(model, 0.99)
    assert plan.policy.tolist() == [1] * 6
    # A birth-death chain: the stationary distribution goes up by up/down from state to state.
    up = np.array([0.6, 0.35, 0.35, 0.35, 0.35])
    down = np.array([0.05, 0.05, 0.05, 0.05, 0.4])
    weights = np.concatenate([[1.0], np.cumprod(up / down)])
    gain = weights[-1] / weights.sum()
    assert gain == pytest.approx(0.4286, abs=5e-5)
    ever = policy_return(model, plan.policy, 2_000).expected_return
    later = policy_return(model, plan.policy, 1_000).expected_return
    assert (ever - later) / 1_000 == pytest.approx(gain, rel=1e-9)
    left = policy_return(model, np.zeros(6, int), 20).expected_return
    assert left == pytest.approx(20 * 0.005)


# --- DeepSea -------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [2, 10, 30])
@pytest.mark.parametrize("map_seed", [None, 0, 5])
def test_the_treasure_is_worth_99_hundredths(size, map_seed) -> None:
    kwargs = {"size": size, "map_seed": map_seed}
    assert optimum_of("DeepSea-v0", **kwargs) == pytest.approx(0.99, abs=1e-12)
    # Moves to the right are paid for as long as none has failed.
    goes_well = (1 - 1 / size) ** np.arange(size)
    best = goes_well[-1] - 0.01 / size * goes_well.sum()
    slippery = optimum_of("DeepSea-v0", deterministic=False, **kwargs)
    assert slippery == pytest.approx(best, abs=1e-12)


def test_one_dive_in_all_finds_the_treasure() -> None:
    model = model_of("DeepSea-v0", size=4)
    n_best = 0
    for actions in np.ndindex(2, 2, 2, 2):
        state, total = 0, 0.0
        for action in actions:
            total += model.reward[state, action, 0]
            state = model.next_state[state, action, 0]
        assert state == 16
        n_best += total == pytest.approx(0.99)
    assert n_best == 1


def test_a_dive_without_shuffled_actions() -> None:
    env = gym.make("DeepSea-v0", size=3, map_seed=None).unwrapped
    env.reset(seed=0)
    states, rewards, terminated = walk(env, [1, 0, 1])
    assert states == [4, 6, 9]
    assert rewards == pytest.approx([-0.01 / 3, 0, -0.01 / 3])
    assert terminated
    env.reset()
    assert walk(env, [1, 1, 1])[1][-1] == pytest.approx(1 - 0.01 / 3)


def test_corners_of_the_sea_have_noise_where_it_is_rough() -> None:
    model = model_of("DeepSea-v0", size=5, deterministic=False)
    noisy = np.flatnonzero(model.reward_variance.max(axis=(1, 2)))
    assert noisy.tolist() == [20, 24]
    assert model_of("DeepSea-v0", size=5).reward_variance is None


# --- what they share -----------------------------------------------------------------------------


# An agent that plans has to see where it is.
@pytest.mark.parametrize("env_id", sorted(LIMITS.keys() - {"ShortCorridor-v0"}))
def test_an_agent_that_plans_reaches_the_optimum(env_id) -> None:
    env = gym.make(env_id, max_episode_steps=30)
    model, states = transition_model(env), np.arange(env.observation_space.n)
    agent = load_algorithm("optimal")(env=env, seed=0)
    agent.plan()
    plan = agent.policy.actions_after(states[None], np.arange(30)[:, None])
    found = policy_return(model, plan, 30).expected_return
    assert found == pytest.approx(finite_horizon_optimum(model, 30).start_value, abs=1e-9)


def sampled_steps(env, state, action, n):
    found = []
    for _ in range(n):
        env.s = state
        found.append(env.step(action)[:2])
    return np.array([step[0] for step in found]), np.array([step[1] for step in found])


@pytest.mark.parametrize(
    ("env_id", "kwargs", "state", "action"),
    [
        ("DeepSea-v0", {"size": 4, "deterministic": False, "map_seed": None}, 15, 1),
        ("MaximizationBias-v0", {"reward_mean": 2, "reward_std": 3}, 1, 4),
        ("JacksCarRental-v0", {}, 21 * 3 + 2, 6),
        ("JacksCarRental-v0", {"variant": "exercise"}, 21 * 15 + 12, 10),
    ],
)
def test_drawn_rewards_have_the_models_mean_and_variance(env_id, kwargs, state, action) -> None:
    env = gym.make(env_id, **kwargs).unwrapped
    env.reset(seed=4)
    model, n = env.transition_model(), 20_000
    states, rewards = sampled_steps(env, state, action, n)
    prob, mean = model.prob[state, action], model.reward[state, action]
    expected = prob @ mean
    variance = prob @ (model.reward_variance[state, action] + (mean - expected) ** 2)
    assert rewards.mean() == pytest.approx(expected, abs=4 * np.sqrt(variance / n))
    assert rewards.var() == pytest.approx(variance, rel=0.06)
    counts = np.bincount(states, minlength=model.n_states)
    chances = np.zeros(model.n_states)
    np.add.at(chances, model.next_state[state, action], prob)
    assert (np.abs(counts - n * chances) <= 5 * np.sqrt(n * chances) + 3).all()


@pytest.mark.parametrize(
    ("env_id", "reason"),
    [
        ("MaximizationBias-v0", "rewards are drawn, and the environment's model holds their means"),
        ("RiverSwim-v0", "compiled"),
        ("WindyGridworld-v0", "compiled"),
        ("Racetrack-v0", "compiled"),
    ],
)
def test_the_engine_says_whether_it_compiles(env_id, reason) -> None:
    agent = load_algorithm("qlearning")(env=env_id, seed=0)
    agent._setup_learn(10, None)
    choose_engine(agent, agent._init_callback(None), None)
    assert agent.engine_in_use.removeprefix("interpreted: ") == reason


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("GamblersProblem-v0", {"goal": 20}),
        ("RandomWalk-v0", {"n_states": 300, "max_jump": 30}),
        ("WindyGridworld-v0", {"moves": "king", "stochastic": True}),
    ],
)
def test_both_engines_end_in_the_same_bits(env_id, kwargs) -> None:
    tables, states = [], []
    for engine in ("compiled", "interpreted"):
        env = gym.make(env_id, **kwargs)
        agent = load_algorithm("qlearning")(env=env, engine=engine, seed=3).learn(3000)
        tables.append(agent.policy.q_tables.numpy())
        states.append(env.unwrapped.s)
    np.testing.assert_array_equal(tables[0], tables[1])
    assert states[0] == states[1]


@pytest.mark.parametrize(
    ("env_id", "wrong", "message"),
    [
        ("RandomWalk-v0", {"n_states": 0}, "n_states must be a whole number from 1 to 10000"),
        ("RandomWalk-v0", {"n_states": 9999, "max_jump": 9999}, "is too much: twice their product"),
        ("WindyGridworld-v0", {"moves": "queen"}, "unknown moves 'queen'"),
        ("WindyGridworld-v0", {"stochastic": 1}, "stochastic must be true or false"),
        ("GamblersProblem-v0", {"heads_probability": 2}, "heads_probability must be a finite"),
        ("GamblersProblem-v0", {"start_capital": 100}, "start_capital must be a whole number"),
        ("MaximizationBias-v0", {"n_actions": 1}, "n_actions must be a whole number from 2"),
        ("MaximizationBias-v0", {"reward_std": -1}, "reward_std must be a finite number"),
        ("RiverSwim-v0", {"n_states": 1}, "n_states must be a whole number from 2"),
        ("DeepSea-v0", {"size": 1}, "size must be a whole number from 2"),
        ("DeepSea-v0", {"map_seed": -1}, "map_seed must be a whole number"),
        ("Racetrack-v0", {"track": "middle"}, "unknown track 'middle'"),
        ("JacksCarRental-v0", {"variant": "exam"}, "unknown variant 'exam': did you mean 'exam"),
        ("JacksCarRental-v0", {"first_cars": 21}, "first_cars must be a whole number from 0 to 20"),
    ],
)
def test_arguments_out_of_range_are_refused(env_id, wrong, message) -> None:
    with pytest.raises(ValueError, match=message):
        gym.make(env_id, **wrong)


def test_numbers_on_the_edge_choose_as_toy_text_does() -> None:
    probabilities = np.array([0.25, 0.0, 0.25, 0.5])
    uniforms = [0.0, np.nextafter(0.25, 0), 0.25, 0.5, np.nextafter(1, 0)]
    assert [first_above(probabilities.cumsum(), uniform) for uniform in uniforms] == [0, 0, 2, 3, 3]
    # Rounding may leave the last sum below a number.
    assert first_above([0.5, 0.75], 0.9) == 0


def test_probabilities_that_sum_to_one_exactly() -> None:
    given = np.array([[0.1] * 10, [0.3, 0.7] + [0.0] * 8])
    found = summing_to_one(given)
    assert (found.cumsum(axis=1)[:, -1] == 1).all()
    np.testing.assert_allclose(found, given, atol=1e-15)
    assert (found[1, 2:] == 0).all()


def test_states_are_worth_what_agents_predict() -> None:
    model = model_of("RandomWalk-v0")
    values = state_values(model, np.zeros(7, int), 1000)
    np.testing.assert_allclose(values[1:6], np.arange(1, 6) / 6, atol=1e-9)

"""Environments of the literature against what it prints, closed forms, and rules by hand."""

import re

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.toy_text.blackjack import BlackjackEnv

from rl_yardstick import mdp
from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.compiled.worlds import NotCompilable, compile_envs
from rl_yardstick.envs import known_models as known
from rl_yardstick.envs.blackjack_model import blackjack_observations, natural_state, state_of
from rl_yardstick.envs.pomdp import _hallway
from rl_yardstick.envs.wrappers import FlattenToDiscrete


def model_of(env_id, **kwargs):
    return known.transition_model(gym.make(env_id, **kwargs))


def optimum_of(env_id, **kwargs):
    limit = known.time_limit(gym.make(env_id, **kwargs))
    return mdp.finite_horizon_optimum(model_of(env_id, **kwargs), limit).start_value


def optimal_values(env_id, **kwargs):
    return mdp.policy_iteration(model_of(env_id, **kwargs), 1.0).values


def chances(model, state, action):
    """What may come of an action: the chance of each state, by its number."""
    found = np.zeros(model.n_states)
    np.add.at(found, model.next_state[state, action], model.prob[state, action])
    return found


def test_values_of_short_walks_are_those_of_the_book():
    # Examples 6.2 and 7.1.
    values = optimal_values("RandomWalk-v0")
    np.testing.assert_allclose(values[1:6], np.arange(1, 6) / 6, atol=1e-9)
    values = optimal_values("RandomWalk-v0", n_states=19, left_reward=-1)
    np.testing.assert_allclose(values[1:20], np.arange(-18, 19, 2) / 20, atol=1e-9)


def test_the_second_state_of_the_corridor_alone_is_reversed():
    # Example 13.1: v1 = 1 + p v2 + (1-p) v1, v2 = 1 + p v1 + (1-p) v3, v3 = 1 + (1-p) v2.
    p, env = 0.59, gym.make("ShortCorridor-v0").unwrapped
    found = mdp.policy_return(env.transition_model(), np.tile([1 - p, p], (4, 1)), 20_000)
    assert found.expected_return == pytest.approx(-(4 - 2 * p) / (p * (1 - p)), rel=1e-9)
    env.reset(seed=0)
    steps = [(env.step(action)[1:3], env.s) for action in (0, 1, 1, 1, 0, 0, 1, 0, 1, 0, 1)]
    assert [state for _, state in steps[:-1]] == [0, 1, 0, 1, 2, 1, 0, 0, 1, 2]
    assert [told for told, _ in steps] == [(-1.0, False)] * 10 + [(-1.0, True)]


def test_the_shortest_ways_and_every_step_in_the_wind():
    for name, steps in (("rook", 15), ("king", 7), ("king_and_stay", 7)):
        assert optimum_of("WindyGridworld-v0", moves=name) == -steps
    model = model_of("WindyGridworld-v0", moves="king_and_stay", stochastic=True)
    moves = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1), (0, 0)]
    assert model.n_actions == 9
    for state in set(range(70)) - {37}:
        for action, (down, right) in enumerate(moves):
            by_hand, wind = np.zeros(70), (0, 0, 0, 1, 1, 1, 2, 2, 1, 0)[state % 10]
            for gust in (-1, 0, 1):
                row = state // 10 + down - (wind + gust if wind else 0)
                by_hand[10 * min(max(row, 0), 6) + min(max(state % 10 + right, 0), 9)] += 1 / 3
            np.testing.assert_allclose(chances(model, state, action), by_hand, atol=1e-15)
    assert (model.reward[np.arange(70) != 37] == -1).all()


def test_values_of_the_gambler_are_those_of_bold_play():
    values = optimal_values("GamblersProblem-v0")
    # Dubins and Savage (1965): staking all that may be staked is optimal on an unfair coin.
    bold = np.eye(101)[100]
    for _ in range(200):
        for capital in range(1, 100):
            stake = min(capital, 100 - capital)
            bold[capital] = 0.4 * bold[capital + stake] + 0.6 * bold[capital - stake]
    np.testing.assert_allclose(values[1:100], bold[1:100], atol=1e-9)
    assert values[[25, 50, 75]] == pytest.approx([0.16, 0.4, 0.4 + 0.6 * 0.4], abs=1e-12)


def test_a_stake_that_is_too_large_is_not_taken():
    model = model_of("GamblersProblem-v0", start_capital=30)
    reached = [set(model.next_state[30, action].tolist()) for action in (31, 0, 30)]
    assert reached == [{30}, {30}, {0, 60}]
    env = gym.make("GamblersProblem-v0")
    masks = known.action_masks_of_states(env)
    assert masks[30].tolist() == [True] * 31 + [False] * 20
    assert masks[90].sum() == 11
    np.testing.assert_allclose(env.unwrapped.initial_state_distrib[1:100], 1 / 99)
    assert gym.make("GamblersProblem-v0", start_capital=7).reset()[0] == 7
    assert known.success_outcomes(env)[50, 50].tolist() == [True, False]


def test_right_is_the_optimum_of_maximization_bias():
    model = model_of("MaximizationBias-v0", n_actions=5)
    assert mdp.value_iteration(model, 1.0).policy[2] == 1
    found = [mdp.policy_return(model, np.full(4, action), 100) for action in (0, 1)]
    assert [result.expected_return for result in found] == [-0.1, 0.0]
    assert [result.return_variance for result in found] == [1.0, 0.0]
    assert [result.expected_length for result in found] == [2.0, 1.0]
    # In A two actions are allowed, and the others repeat them.
    assert model.next_state[2, :, 0].tolist() == [1, 3, 1, 3, 1]
    masks = known.action_masks_of_states(gym.make("MaximizationBias-v0", n_actions=5))
    assert masks[2].tolist() == [True, True, False, False, False]
    assert masks[1].all()


def test_swimming_right_for_ever_earns_what_its_chain_says():
    model = model_of("RiverSwim-v0")
    policy = mdp.value_iteration(model, 0.99).policy
    assert policy.tolist() == [1] * 6
    # A birth-death chain: the stationary distribution goes up by up/down from state to state.
    up = np.array([0.6, 0.35, 0.35, 0.35, 0.35])
    down = np.array([0.05, 0.05, 0.05, 0.05, 0.4])
    weights = np.concatenate([[1.0], np.cumprod(up / down)])
    gain = weights[-1] / weights.sum()
    assert gain == pytest.approx(0.4286, abs=5e-5)
    earned = [mdp.policy_return(model, policy, n).expected_return for n in (1_000, 2_000)]
    assert (earned[1] - earned[0]) / 1_000 == pytest.approx(gain, rel=1e-9)


@pytest.mark.parametrize(("size", "map_seed"), [(2, 0), (10, None)])
def test_the_treasure_is_worth_99_hundredths(size, map_seed):
    kwargs = {"size": size, "map_seed": map_seed}
    assert optimum_of("DeepSea-v0", **kwargs) == pytest.approx(0.99, abs=1e-12)
    # Moves to the right are paid for as long as none has failed.
    goes_well = (1 - 1 / size) ** np.arange(size)
    best = goes_well[-1] - 0.01 / size * goes_well.sum()
    slippery = optimum_of("DeepSea-v0", deterministic=False, **kwargs)
    assert slippery == pytest.approx(best, abs=1e-12)
    # From the top left, to the right: one row below, in the next column or in the same.
    model = known.transition_model(gym.make("DeepSea-v0", deterministic=False, **kwargs))
    right = 1 if map_seed is None else int(model.prob[0, 1, 1] > 0)
    assert model.next_state[0, right].tolist() == [size + 1, size]
    assert model.prob[0, right].tolist() == [1 - 1 / size, 1 / size]


COAST, FASTER_UP, SLOWER_UP, FASTER_RIGHT, SLOWER_RIGHT = 4, 7, 1, 5, 3


def back_to_the_line(chance=1.0):
    return {((31, column, 0, 0), False): chance / 6 for column in range(3, 9)}


STEPS = [
    # A car moves by its new velocity, from 0 to 4, and stops on the starting line alone.
    (0, (31, 4, 0, 0), FASTER_UP, {((30, 4, 1, 0), False): 1.0}),
    (0, (20, 5, 2, 1), FASTER_RIGHT, {((18, 7, 2, 2), False): 1.0}),
    (0, (31, 5, 0, 1), SLOWER_RIGHT, {((31, 5, 0, 0), False): 1.0}),
    # It leaves the track, at the end of its move and on the way.
    (0, (20, 8, 1, 0), FASTER_RIGHT, back_to_the_line()),
    (0, (8, 8, 2, 2), FASTER_UP, back_to_the_line()),
    # It finishes, whatever lies beyond, but not beyond the upper edge before the line.
    (0, (0, 15, 1, 4), COAST, {((0, 16, 1, 4), True): 1.0}),
    (0, (0, 13, 3, 3), COAST, back_to_the_line()),
    # With noise the velocity may stay as it is.
    (0.1, (20, 5, 2, 0), FASTER_RIGHT, {((18, 6, 2, 1), False): 0.9, ((18, 5, 2, 0), False): 0.1}),
    (0.1, (20, 8, 1, 0), FASTER_RIGHT, {**back_to_the_line(0.9), ((19, 8, 1, 0), False): 0.1}),
]


@pytest.mark.parametrize(("noise", "start", "action", "expected"), STEPS)
def test_steps_of_the_racetrack(noise, start, action, expected):
    """What may come of an action: (row, column, up, right), terminated, by probability."""
    env = gym.make("Racetrack-v0", noise=noise).unwrapped
    model, found, letters = env.transition_model(), {}, "".join(env.rows)
    cells = [divmod(i, len(env.rows[0])) for i, letter in enumerate(letters) if letter != "#"]
    at = 25 * cells.index(start[:2]) + 5 * start[2] + start[3], action
    columns = model.prob[at], model.next_state[at], model.terminated[at]
    for prob, after, ends in zip(*columns, strict=True):
        key = (*cells[after // 25], after // 5 % 5, after % 5), bool(ends)
        found[key] = found.get(key, 0) + prob
    assert {key: prob for key, prob in found.items() if prob > 0} == pytest.approx(expected)


def test_without_noise_the_race_takes_ten_steps_and_more():
    # From the six cells of the start the shortest ways take 10, 10, 10, 10, 11 and 12 steps. From
    # the last one a crash is a gain: one step, and then the mean m of all cells. With that,
    # 6 m = 10 + 10 + 10 + 10 + 11 + (1 + m).
    assert optimum_of("Racetrack-v0", noise=0) == pytest.approx(-52 / 5)


N = 21


def test_the_exercise_adds_a_free_move_and_fees_for_parking():
    example, exercise = (gym.make("JacksCarRental-v0", variant=v) for v in ("example", "exercise"))
    one, two, moved = np.ogrid[:N, :N, -5:6]
    possible = (moved <= one) & (-moved <= two)
    left, right = np.minimum(one - moved, 20), np.minimum(two + moved, 20)
    added = 2 * (moved > 0) - 4 * (left > 10) - 4 * (right > 10)
    models = [env.unwrapped.transition_model() for env in (example, exercise)]
    np.testing.assert_array_equal(models[0].prob, models[1].prob)
    found = (models[1].expected_reward - models[0].expected_reward).reshape(N, N, 11)
    np.testing.assert_allclose(found[possible], added[possible], atol=1e-9)
    assert np.array_equal(known.action_masks_of_states(example).reshape(N, N, 11), possible)
    # More cars than there are cannot be moved: 2 and 0 of them here.
    for array in (models[0].prob, models[0].reward):
        np.testing.assert_array_equal(array[2 * N, [10, 0]], array[2 * N, [7, 5]])


def test_optimal_values_and_policy_are_those_of_figure_4_2():
    masks = known.action_masks_of_states(gym.make("JacksCarRental-v0"))
    plan = mdp.policy_iteration(model_of("JacksCarRental-v0"), 0.9, mask=masks)
    values, moves = plan.values.reshape(N, N), plan.policy.reshape(N, N) - 5
    assert (values[20, 20], values[0, 0]) == pytest.approx((636.99, 421.41), abs=0.005)
    # The borders of the figure: nothing to move with few cars, five from a full first place.
    assert moves[20].tolist() == [5, 5, 5, 5, 4, 4, 3, 3, 3, 3, 2, 2, 2, 2, 2, 1, 1, 1, 0, 0, 0]
    assert moves[0].tolist() == [0] * 8 + [-1, -1, -2, -2, -2, -3, -3, -3, -3, -3, -4, -4, -4]
    env = gym.make("JacksCarRental-v0", first_cars=2, second_cars=0, render_mode="ansi")
    assert env.reset(seed=0)[0] == 2 * N
    assert re.search(r"cars at the \w+ place +2 of 20  =+\n", env.render())
    env.step(7)
    assert env.render().startswith("moved +2\n")


@pytest.mark.parametrize(
    ("env_id", "kwargs", "state", "action"),
    [
        ("MaximizationBias-v0", {"reward_mean": 2, "reward_std": 3}, 1, 4),
        ("JacksCarRental-v0", {"variant": "exercise"}, 21 * 15 + 12, 10),
    ],
)
def test_drawn_rewards_have_the_models_mean_and_variance(env_id, kwargs, state, action):
    env, n, found = gym.make(env_id, **kwargs).unwrapped, 4000, []
    env.reset(seed=4)
    for _ in range(n):
        env.s = state
        found.append(env.step(action)[:2])
    states, rewards = np.array(found).T
    model = env.transition_model()
    prob, mean = model.prob[state, action], model.reward[state, action]
    expected = prob @ mean
    variance = prob @ (model.reward_variance[state, action] + (mean - expected) ** 2)
    # Five standard errors of each; that of a normal variance is itself times sqrt(2 / n).
    assert rewards.mean() == pytest.approx(expected, abs=5 * np.sqrt(variance / n))
    assert rewards.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / n))
    counts, chances = np.bincount(states.astype(int), minlength=len(model.prob)), 0 * model.initial
    np.add.at(chances, model.next_state[state, action], prob)
    assert (np.abs(counts - n * chances) <= 5 * np.sqrt(n * chances) + 3).all()


SUTTON, NATURAL = {"sab": True}, {"sab": False, "natural": True}
PUBLISHED = [(SUTTON, -0.0431), (NATURAL, -0.0257), ({"sab": False, "natural": False}, -0.0466)]
STICK, HIT = 0, 1


def blackjack(rules):
    return known.transition_model(FlattenToDiscrete(gym.make("Blackjack-v1", **rules)))


def test_the_optimum_is_the_one_that_is_published():
    for rules, published in PUBLISHED:
        model = blackjack(rules)
        found = mdp.policy_return(model, mdp.value_iteration(model, 1.0).policy, None)
        assert found.expected_return == pytest.approx(published, abs=5e-5)


def test_the_policy_is_that_of_figure_5_2():
    policy = mdp.value_iteration(blackjack(SUTTON), 1.0).policy
    # Without a usable ace stick from this sum on, by the dealer's card: ace, 2, 3, ..., 10.
    hard = [17, 13, 13, 12, 12, 12, 17, 17, 17, 17]
    soft = [19, 18, 18, 18, 18, 18, 18, 18, 19, 19]
    for dealer in range(1, 11):
        for usable, least, stick_from in ((False, 4, hard), (True, 12, soft)):
            for total in range(least, 22):
                wanted = STICK if total >= stick_from[dealer - 1] else HIT
                assert policy[state_of(total, dealer, usable)] == wanted
        assert policy[natural_state(dealer)] == STICK


def test_a_natural_looks_as_any_21_does_and_wins_are_successes():
    seen = blackjack_observations()
    assert seen[natural_state(10)].tolist() == seen[state_of(21, 10, True)].tolist() == [21, 10, 1]
    flat = known.observations_of_states(FlattenToDiscrete(gym.make("Blackjack-v1")))
    assert flat[:704].tolist() == list(range(704))
    assert flat[natural_state(3)] == state_of(21, 3, True)
    env = gym.make("Blackjack-v1", natural=True, sab=False)
    model, wins = known.transition_model(env), known.success_outcomes(env)
    assert set(model.reward[wins].tolist()) == {1.0, 1.5}
    # With this rule a natural that beats the dealer's 20 pays more, and no other hand.
    paid = (model.reward == 1.5) & (model.prob > 0)
    assert sorted(set(np.nonzero(paid)[0].tolist())) == [natural_state(up) for up in range(1, 11)]


def test_another_blackjack_is_not_believed_and_none_is_compiled():
    cheating, changed = type("Cheating", (BlackjackEnv,), {})(), BlackjackEnv()
    changed.step = lambda action: None
    assert known.transition_model(cheating) is known.transition_model(changed) is None
    agent = load_algorithm("qlearning")(env=FlattenToDiscrete(gym.make("Blackjack-v1")))
    with pytest.raises(NotCompilable, match="does not continue from the state"):
        compile_envs(agent.env)


def test_the_tiger_is_heard_where_it_is_with_the_accuracy():
    env = gym.make("Tiger-v0", accuracy=0.8)
    model, heard = known.transition_model(env), known.observations_of_states(env)
    hidden = [env.unwrapped.cell_of(state) for state in range(6)]
    assert (hidden, heard.tolist()) == ([0, 0, 0, 1, 1, 1], [0, 1, 2, 0, 1, 2])
    begins = [0.5, 0, 0, 0.5, 0, 0]
    np.testing.assert_allclose(model.initial, begins)
    for state in range(6):
        listened = [0, 0.8, 0.2, 0, 0, 0] if state < 3 else [0, 0, 0, 0, 0.2, 0.8]
        for action, expected in enumerate((listened, begins, begins)):
            np.testing.assert_allclose(chances(model, state, action), expected)
    rewards = [[-1.0, -100.0, 10.0]] * 3 + [[-1.0, 10.0, -100.0]] * 3
    np.testing.assert_allclose(model.expected_reward, rewards)
    assert optimum_of("Tiger-v0") == pytest.approx(100)


NORTH, EAST, SOUTH, WEST = range(4)
STAY, FORWARD, RIGHT, AROUND, LEFT = range(5)


TURNS = {RIGHT: (0.1, 0.7, 0.1, 0.1), AROUND: (0.1, 0.15, 0.6, 0.15), LEFT: (0.1, 0.1, 0.1, 0.7)}
MOVES = [  # rows of the file hallway.POMDP, with its states written as cell and facing
    (0, FORWARD, EAST, {(1, EAST): 0.8, (0, EAST): 0.2}),
    (2, FORWARD, EAST, {(3, EAST): 0.8, (11, SOUTH): 0.05, (1, EAST): 0.025, (1, WEST): 0.025,
                        (2, EAST): 0.1}),
    (2, FORWARD, NORTH, {(3, EAST): 0.05, (11, NORTH): 0.025, (11, SOUTH): 0.025, (1, WEST): 0.05,
                         (2, NORTH): 0.85}),
    (12, FORWARD, SOUTH, {(4, NORTH): 0.025, (4, SOUTH): 0.025, (12, SOUTH): 0.95}),
    *((5, STAY, facing, {(5, facing): 1}) for facing in range(4)),
    *((5, action, facing, {(5, (facing + turn) % 4): by_turn[turn] for turn in range(4)})
      for action, by_turn in TURNS.items() for facing in range(4)),
]  # fmt: skip


@pytest.mark.parametrize(("cell", "action", "facing", "expected"), MOVES)
def test_moves_in_the_hallway_are_those_of_the_original(cell, action, facing, expected):
    """By cell and facing, the chances after an action; cells 0 to 10 are the row, then alcoves."""
    hidden = _hallway().hidden
    state = np.flatnonzero(hidden == 4 * cell + facing)[0]
    found = np.bincount(hidden, chances(model_of("Hallway-v0"), state, action))
    places = np.flatnonzero(found)
    assert {divmod(place, 4): found[place] for place in places} == pytest.approx(expected)


def test_readings_are_those_of_the_original():
    env, model = gym.make("Hallway-v0"), model_of("Hallway-v0")
    # The chances of readings at the start, given where that is, are those after staying there.
    places = _hallway().hidden, _hallway().reading
    first, stayed = np.zeros((2, 60, 21))
    np.add.at(first, places, model.initial)
    for place in range(56):
        there = np.flatnonzero(places[0] == place)[0]
        np.add.at(stayed, places, chances(model, there, STAY))
    np.testing.assert_allclose(stayed, 56 * first, atol=1e-12)
    readings = stayed.reshape(15, 4, 21)
    # Rows of O in the file, rounded there: walls to the north, south and west of the west end.
    told = [0.692550, 0.036464, 0.076949, 0.076949, 0.008549, 0.000949]
    assert readings[0, NORTH, [11, 15, 3, 9, 1, 0]] == pytest.approx(told, abs=3e-5)
    assert readings[1, EAST, 5] == pytest.approx(0.731024, abs=3e-5)
    assert readings[2, NORTH, 8] == pytest.approx(0.771637, abs=3e-5)
    for cell, sign in ((2, 16), (4, 17), (6, 18), (8, 19)):
        assert readings[cell, SOUTH, sign] == pytest.approx(1)
    assert env.observation_space.n == 21
    # The goal's alcove ends the episode with the only reward.
    ends = model.terminated & (model.prob > 0) & model.reachable[:, None, None]
    assert set(model.reward[ends]) == {1.0}
    assert model.reward[~ends & (model.prob > 0) & model.reachable[:, None, None]].max() == 0


def test_the_dark_shows_the_four_cells_beside():
    env = gym.make("DarkWarehouse-v0", desc=["S.G", "#.."], random_start=False)
    seen = known.observations_of_states(env)
    # Above, below, left, right, in base 3: 1 a shelf or the wall, 2 the goal.
    assert [np.base_repr(code, 3).zfill(4) for code in seen.tolist()] == [
        "1110", "1002", "1001", "0110", "0110", "2101",
    ]  # fmt: skip
    assert env.reset(seed=0)[0] == seen[0]
    assert env.step(3)[0] == seen[1]

"""Updates of tables against numbers worked out by hand: one step, bonuses, learnt models."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import FloatSchedule

from rl_yardstick.agents import load_algorithm
from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.mdp import TransitionModel, value_iteration
from tests.agents.hand_fed import Fed

ONE_STEP = ("qlearning", "sarsa", "expected_sarsa", "double_qlearning")

# Two states, three actions. The transition: state 0, action 1, reward 2, then state 1; gamma is a
# half, the step size a tenth.
FIRST_TABLE = [[0.0, 10.0, 0.0], [4.0, 8.0, 6.0]]
SECOND_TABLE = [[0.0, 20.0, 0.0], [3.0, 1.0, 5.0]]
WEIGHTS = np.exp([0.0, 2.0, 1.0])  # of 4, 8 and 6 at temperature 2
SOFTMAX = WEIGHTS @ [4, 8, 6] / WEIGHTS.sum()
T = "terminated"
TENTH, HALF = {"learning_rate": 0.1}, {"learning_rate": 0.5}
AVERAGE, WHOLE = {"learning_rate": "sample_average"}, {"learning_rate": 1.0}
MEANS = [(0, 0, r, 0, T, {(0, 0): mean}) for r, mean in ((4, 4), (1, 2.5), (7, 4), (-2, 2.5))]
# Action 1 is never tried until the end: its bonus grows by sqrt; no time passes for action 0.
WAITING = [(0, 0, 3, 0, T, {(0, 0): 3, (0, 1): 0.5 * np.sqrt(k)}) for k in range(1, 6)]
TO_THE_GOAL = [(0, 0, 0, 1, "", {}), (1, 0, 0, 2, "", {})]
NEWS = {(0, 0): 2, (1, 0): 4, (2, 0): 8}
BY_HAND = {  # agent, table, settings; steps, what they change, and then the mean TD error
    # Best next value 8: 2 + 0.5 * 8 = 6.
    "qlearning": ("qlearning", FIRST_TABLE, {**TENTH, "epsilon": 0.3},
        [(0, 1, 2, 1, "", {(0, 1): 10 + 0.1 * (6 - 10)}, 4)]),
    # The greedy action is what it commits to.
    "sarsa": ("sarsa", FIRST_TABLE, TENTH, [(0, 1, 2, 1, "", {(0, 1): 9.6}, 4)]),
    # Mean of 4, 8, 6 is 6: 0.3 * 6 + 0.7 * 8 = 7.4, and 2 + 0.5 * 7.4 = 5.7.
    "expected_sarsa": ("expected_sarsa", FIRST_TABLE, {**TENTH, "epsilon": 0.3},
        [(0, 1, 2, 1, "", {(0, 1): 10 + 0.1 * (5.7 - 10)}, 4.3)]),
    "expected_sarsa, boltzmann": ("expected_sarsa", FIRST_TABLE,
        {**TENTH, "exploration": "boltzmann", "temperature": 2.0},
        [(0, 1, 2, 1, "", {(0, 1): 10 + 0.1 * (2 + 0.5 * SOFTMAX - 10)})]),
    "qlearning, averages": ("qlearning", [[123]], AVERAGE, MEANS),
    "qlearning_ucb, averages": ("qlearning_ucb", [[123]], {"bonus_scale": 0, "horizon": 0}, MEANS),
    # 1 + .5 * 2 + .25 * 8 = 4, half-way from 10 on: 7. The end: 2 + .5 * 4 = 4 from state 1 on, and
    # 4 from state 2 on. Another episode's first step is not learnt from: the errors go on standing.
    "n_step_sarsa": ("n_step_sarsa", [[10, 0], [0, 0], [8, 0]], {**HALF, "n_steps": 2},
        [(0, 0, 1, 1, "", {}, 0), (1, 0, 2, 2, "", {(0, 0): 7}, 6),
         (2, 0, 4, 0, T, {(1, 0): 2, (2, 0): 6}, 4), (0, 0, 1, 1, "", {}, 4)]),
    # Returns from the end: 4, 2 + .5 * 4 = 4, 1 + .5 * 4 = 3: 10 + .5 * (3 - 10) is 6.5.
    "monte_carlo": ("monte_carlo", [[10, 0], [0, 0]], HALF,
        [(0, 0, 1, 1, "", {}), (1, 1, 2, 0, "", {}),
         (0, 0, 4, 0, T, {(0, 0): 6.5, (1, 1): 2}, (4 + 7) / 2)]),
    # 1 + .5 * (2 + .5 * 8), and what is left counts as another episode.
    "monte_carlo, a full record": ("monte_carlo", [[0, 0], [0, 0], [8, 0]],
        {**AVERAGE, "longest_episode": 2},
        [(0, 0, 1, 1, "", {}), (1, 1, 2, 2, "", {(0, 0): 4, (1, 1): 6}),
         (2, 0, 6, 0, T, {(2, 0): 6})]),
    # Only one pair is known: one real update and three imagined ones, from 0 towards 2 + 4.
    "dyna_q": ("dyna_q", [[0, 0], [4, 8]], {**TENTH, "planning_steps": 3},
        [(0, 1, 2, 1, "", {(0, 1): 6 * (1 - 0.9**4)}, 6)]),
    # The last outcome thrice, with a step size of one over the real visits.
    "dyna_q, averages": ("dyna_q", [[0]], {**AVERAGE, "planning_steps": 2},
        [(0, 0, 4, 0, T, {(0, 0): 4}), (0, 0, 1, 0, T, {(0, 0): 1 + 3 / 2**3})]),
    "dyna_q_plus": ("dyna_q_plus", [[0, 0]],
        {**WHOLE, "gamma": 0.0, "kappa": 0.5, "planning_steps": 40},
        [*WAITING, (0, 1, 7, 0, T, {(0, 0): 3 + 0.5, (0, 1): 7})]),
    # Only planning earns the bonus.
    "dyna_q_plus, not planning": ("dyna_q_plus", [[0, 0]],
        {**WHOLE, "gamma": 0.0, "kappa": 0.5, "planning_steps": 0},
        [(0, 0, 3, 0, T, {(0, 0): 3})]),
    # Three states in a row: news of the goal runs backwards, as far as there are planning steps.
    "prioritized_sweeping": ("prioritized_sweeping", np.zeros((4, 1)), WHOLE,
        [*TO_THE_GOAL, (2, 0, 8, 3, T, NEWS, 8)]),
    "prioritized_sweeping, two steps": ("prioritized_sweeping", np.zeros((4, 1)),
        {**WHOLE, "planning_steps": 2},
        [*TO_THE_GOAL, (2, 0, 8, 3, T, {(1, 0): 4, (2, 0): 8}), (2, 0, 8, 3, T, {(0, 0): 2})]),
    "prioritized_sweeping, a threshold": ("prioritized_sweeping", np.zeros((4, 1)),
        {**WHOLE, "threshold": 2.0}, [*TO_THE_GOAL, (2, 0, 8, 3, T, {**NEWS, (0, 0): 0})]),
    # Once back, once on: 0.5 * (1 + .5 V(0)) + 0.5 * (3 + .5 V(1)), where both are worth 10. The
    # other action ends the episode: V(0) = max(Q(0, 0), 4), Q(0, 0) = 4.5 + .25 V(0) = 6. What is
    # known is known: the last step changes nothing.
    "r_max": ("r_max", np.full((2, 2), 10),
        {"known_after": 2, "value_bound": 10.0, "tolerance": 1e-12},
        [(0, 0, 1, 0, "", {}, 4), (0, 0, 3, 1, "", {(0, 0): 7}), (0, 1, 4, 1, T, {}),
         (0, 1, 4, 1, T, {(0, 0): 6, (0, 1): 4}), (0, 1, 400, 0, "", {})]),
}  # fmt: skip

# These learn of a step later.
LATE = {"n_step_sarsa", "monte_carlo"}


@pytest.mark.parametrize("row", BY_HAND)
def test_updates_by_hand(row):
    name, table, settings, steps = BY_HAND[row]
    fed = Fed(name, table, **settings)
    expected, visits = fed.table.copy(), np.zeros_like(fed.table)
    for *step, changes, error in (each if len(each) == 7 else (*each, None) for each in steps):
        for place, value in changes.items():
            expected[place] = value
        visits[tuple(step[:2])] += 1
        np.testing.assert_allclose(fed.step(*step), expected, rtol=1e-12, atol=1e-10)
        assert error is None or fed.agent.mean_td_error == pytest.approx(error, rel=1e-12)
    assert name in LATE or np.array_equal(fed.agent.policy.visit_counts[0], visits)
    if name in ONE_STEP:
        assert fed.committed == (1 if name == "sarsa" else -1)


def test_sarsa_judges_by_the_action_that_it_commits_to():
    met = set()
    for seed in range(9):
        fed = Fed("sarsa", FIRST_TABLE, 1.0, learning_rate=0.1, seed=seed)
        value = fed.step(0, 1, 2, 1)[0, 1]
        assert value == pytest.approx(10 + 0.1 * (2 + 0.5 * [4, 8, 6][fed.committed] - 10))
        met.add(fed.committed)
    assert met == {0, 1, 2}


def test_double_q_learning_judges_by_the_other_table():
    # The first table prefers action 1 (8), of which the second thinks 1; the second prefers action
    # 2 (5), of which the first thinks 6.
    expected = {0: 10 + 0.1 * (2 + 0.5 * 1 - 10), 1: 20 + 0.1 * (2 + 0.5 * 6 - 20)}
    met = set()
    for seed in range(9):
        fed = Fed("double_qlearning", [FIRST_TABLE, SECOND_TABLE], learning_rate=0.1, seed=seed)
        fed.step(0, 1, 2, 1)
        ((table, *place),) = np.argwhere(fed.agent.policy.visit_counts.numpy())
        assert place == [0, 1]
        values = fed.agent.policy.q_tables[:, 0, 1].tolist()
        assert values[table] == pytest.approx(expected[table], rel=1e-14)
        assert values[1 - table] == [10, 20][1 - table]
        met.add(table)
    assert met == {0, 1}


@pytest.mark.parametrize("name", ONE_STEP)
def test_termination_leaves_the_reward_alone_and_truncation_does_not(name):
    table = [[1, 1], [8, 8]]
    for end, targets in (("terminated", {2}), ("truncated", {6}), ("", {6})):
        fed = Fed(name, table, learning_rate=1.0)
        fed.step(0, 1, 2, 1, end)
        assert set(fed.agent.policy.q_tables[:, 0, 1].tolist()) - {1} == targets
        skipping = Fed(name, table, learning_rate=1.0, skip_terminal_update=True)
        skipping.step(0, 1, 2, 1, end)
        assert int(skipping.agent.policy.visit_counts.sum()) == (end != "terminated")


def test_one_update_by_hand():
    """Thrice the same step: state 0, action 1, reward 2, then state 1; H = 3, bonus 6 / sqrt(N)."""
    settings = {"value_bound": 10.0, "bonus_scale": 6.0, "horizon": 3.0}
    fed = Fed("qlearning_ucb", [[10, 10], [4, 8]], **settings)
    # The first target replaces what was there: 2 + 6 + 0.5 * 8.
    assert fed.step(0, 1, 2, 1)[0].tolist() == [10, 12]
    assert fed.agent.mean_td_error == 2
    # The second weighs 4/5, and the state that follows counts for 10 at most, though it shows 30.
    fed.table[1, 0] = 30
    second = 12 + 0.8 * (2 + 6 / np.sqrt(2) + 0.5 * 10 - 12)
    assert fed.step(0, 1, 2, 1)[0, 1] == pytest.approx(second, rel=1e-15)
    # The third weighs 4/6; nothing follows.
    third = second + 4 / 6 * (2 + 6 / np.sqrt(3) - second)
    assert fed.step(0, 1, 2, 1, "terminated")[0, 1] == pytest.approx(third, rel=1e-15)
    assert fed.agent.policy.visit_counts[0].tolist() == [[0, 3], [0, 0]]


def test_tables_begin_where_they_are_told_to():
    made = {"env": "Taxi-v4", "gamma": 0.5, "seed": 0}
    # Rewards of at most 1 come to 1 / (1 - gamma) at most.
    assert (load_algorithm("qlearning_ucb")(**made).policy.q_table == 2).all()
    assert (load_algorithm("r_max")(value_bound=3.0, **made).policy.q_table == 3).all()
    drawn = load_algorithm("qlearning")(initial_q=5.0, initial_q_std=2.0, **made).policy.q_table
    # 3000 entries: mean and standard deviation within four standard errors.
    assert drawn.mean() == pytest.approx(5, abs=4 * 2 / 3000**0.5)
    assert drawn.std() == pytest.approx(2, abs=4 * 2 / 6000**0.5)


def test_planning_draws_pairs_and_outcomes_alike():
    """With a step size of nearly 0 the sum of updates tells how often which reward was drawn."""
    n, tiny = 30_000, 1e-12
    fed = Fed("dyna_q", np.zeros((2, 1)), gamma=0.0, planning_steps=0, outcomes_kept=3)
    fed.agent.lr_schedule = FloatSchedule(0.0)
    for obs, reward in ((0, 1), (0, 10), (0, 100), (1, 1000)):
        fed.step(obs, 0, reward, 0)
    fed.agent.planning_steps, fed.agent.lr_schedule = n, FloatSchedule(tiny)
    drawn = fed.step(1, 0, 1000, 0)[:, 0] / tiny / n
    # Half of them on each pair; a third on each outcome. Four standard errors.
    assert drawn[1] == pytest.approx(500, abs=4 * 1000 * 0.5 / n**0.5)
    assert drawn[0] == pytest.approx(111 / 6, abs=4 * 100 * (1 / 6) ** 0.5 / n**0.5)


MAZE = {"desc": ["S.#", "..G"], "step_reward": 0, "shelf_reward": 0, "goal_reward": 1}


@pytest.mark.parametrize("name", ["dyna_q", "prioritized_sweeping"])
def test_much_planning_ends_in_the_optimum(name):
    """All pairs of a small maze were tried: their values are those of the best policy, exactly."""
    env = make_vec_env("Warehouse-v0", seed=0, env_kwargs=MAZE)
    uniform = {"exploration_decay": "constant", "exploration_initial_eps": 1.0}
    settings = {"planning_steps": 50, "learning_rate": 1.0, **uniform}
    settings |= {"threshold": 0} if name == "prioritized_sweeping" else {}
    agent = load_algorithm(name)(env=env, seed=0, gamma=0.9, **settings).learn(1500)
    model = transition_model(gym.make("Warehouse-v0", **MAZE))
    tried = agent.policy.model.counts > 0
    assert tried[model.reachable].all()
    expected = value_iteration(model, 0.9).action_values
    np.testing.assert_allclose(agent.policy.q_table[tried], expected[tried], atol=1e-12)


def test_the_largest_error_comes_first():
    fed = Fed("prioritized_sweeping", np.zeros((8, 1)), planning_steps=0, learning_rate=1.0)
    rewards = [3, -7, 1, 5, 2, -4, 6]
    for obs, reward in enumerate(rewards):
        fed.step(obs, 0, reward, 7, "terminated")
    fed.step(6, 0, -0.5, 7, "terminated")  # as urgent as before, but another reward
    fed.agent.planning_steps = 1
    order = []
    for _ in rewards:
        before = fed.table[:, 0].copy()
        fed.step(7, 0, 0, 7, "terminated")
        order.append(int(np.flatnonzero(fed.table[:, 0] != before)[0]))
    assert order == [1, 6, 3, 5, 0, 4, 2]
    assert fed.table[:, 0].tolist() == [3, -7, 1, 5, 2, -4, -0.5, 0]


def test_r_max_plans_the_optimum_of_what_it_has_counted():
    env = make_vec_env("FrozenLake-v1", 2, seed=0)
    settings = {"known_after": 4, "value_bound": 1.0, "gamma": 0.9, "tolerance": 1e-9}
    agent = load_algorithm("r_max")(env=env, seed=0, **settings).learn(400)
    model = agent.policy.model
    known = (model.counts == 4)[..., None]
    assert 20 < known.sum() < known.size
    # What is not known ends the episode, and earns the most.
    counted = TransitionModel(
        prob=np.where(known, model.tallies / 4, [1.0, 0, 0, 0]),
        next_state=model.next_obs,
        reward=np.where(known, model.rewards / np.maximum(model.tallies, 1), 1.0),
        terminated=model.terminated | ~known,
        initial=np.full(16, 1 / 16),
    )
    optimum = value_iteration(counted, 0.9).action_values
    np.testing.assert_allclose(agent.policy.q_table, optimum, atol=1e-8)

"""Updates of tables against numbers worked out by hand: one step, bonuses, learnt models."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import FloatSchedule

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.tabular.prioritized_sweeping import NONE
from envs.known_models import transition_model
from mdp import TransitionModel, value_iteration
from tests.agents.hand_fed import Fed

ONE_STEP = ("qlearning", "sarsa", "expected_sarsa", "double_qlearning")

# --- one step ------------------------------------------------------------------------------------

# Two states, three actions. The transition: state 0, action 1, reward 2, then state 1; gamma is a
# half, the step size a tenth.
FIRST_TABLE = [[0.0, 10.0, 0.0], [4.0, 8.0, 6.0]]
SECOND_TABLE = [[0.0, 20.0, 0.0], [3.0, 1.0, 5.0]]
WEIGHTS = np.exp([0.0, 2.0, 1.0])  # of 4, 8 and 6 at temperature 2


@pytest.mark.parametrize(
    ("name", "epsilon", "settings", "target"),
    [
        # Best next value 8: 2 + 0.5 * 8.
        ("qlearning", 0.3, {}, 6.0),
        # The greedy action is what it commits to.
        ("sarsa", 0.0, {}, 6.0),
        # Mean of 4, 8, 6 is 6: 0.3 * 6 + 0.7 * 8 = 7.4, and 2 + 0.5 * 7.4.
        ("expected_sarsa", 0.3, {}, 5.7),
        (
            "expected_sarsa",
            0.0,
            {"exploration": "boltzmann", "temperature": 2.0},
            2 + 0.5 * (WEIGHTS @ [4, 8, 6]) / WEIGHTS.sum(),
        ),
    ],
)
def test_one_table(name, epsilon, settings, target):
    fed = Fed(name, FIRST_TABLE, epsilon, learning_rate=0.1, **settings)
    table = fed.step(0, 1, 2, 1)
    assert table[0, 1] == pytest.approx(10 + 0.1 * (target - 10), rel=1e-14)
    assert fed.agent.mean_td_error == pytest.approx(abs(target - 10), rel=1e-14)
    table[0, 1] = 10
    assert table.tolist() == FIRST_TABLE
    assert fed.agent.policy.visit_counts.tolist() == [[[0, 1, 0], [0, 0, 0]]]
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
        assert values == pytest.approx([*(FIRST_TABLE[0][1], SECOND_TABLE[0][1])], abs=2)
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
        changed = int(skipping.agent.policy.visit_counts.sum())
        assert changed == (end != "terminated")


@pytest.mark.parametrize("name", ["qlearning", "qlearning_ucb"])
def test_averages_are_the_mean_of_the_targets(name):
    average = {"learning_rate": "sample_average"}
    own = average if name == "qlearning" else {"bonus_scale": 0.0, "horizon": 0.0}
    fed = Fed(name, [[123.0]], gamma=0.9, **own)
    for n, reward in enumerate((4.0, 1.0, 7.0, -2.0), start=1):
        fed.step(0, 0, reward, 0, "terminated")
        assert fed.table[0, 0] == pytest.approx(np.mean([4.0, 1.0, 7.0, -2.0][:n]))
    assert fed.agent.policy.visit_counts.sum() == 4


# --- in an environment ---------------------------------------------------------------------------

GREEDY = {"exploration_decay": "constant", "exploration_initial_eps": 0.0}


class Corridor(gym.Env):
    """Action 1 moves one cell on and action 0 stays; each step earns the number of the cell."""

    def __init__(self, length=3):
        self.observation_space = spaces.Discrete(length + 1)
        self.action_space = spaces.Discrete(2)
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return self.cell, {}

    def step(self, action):
        self.cell = min(self.cell + int(action), self.length)
        return self.cell, float(self.cell), self.cell == self.length, False, {}


class Tracer(BaseCallback):
    actions, commitments = (), ()

    def _on_step(self):
        self.actions += (int(self.locals["actions"][0]),)
        return True

    def _on_rollout_end(self):
        self.commitments += (int(self.model._next_actions[0]),)


def test_two_episodes_by_hand():
    # Greedy with an optimistic 10 for action 1: straight to the end, each time.
    model = load_algorithm("qlearning")(
        env=Corridor(), learning_rate=0.5, gamma=0.5, seed=0, **GREEDY
    )
    model.policy.q_tables[0, :, 1] = 10.0
    model.learn(3)
    # 10 + .5 * (1 + .5 * 10 - 10), 10 + .5 * (2 + .5 * 10 - 10), 10 + .5 * (3 - 10).
    np.testing.assert_allclose(model.policy.q_table[:3, 1], [8.0, 8.5, 6.5])
    model.learn(3, reset_num_timesteps=False)
    expected = [8 + 0.5 * (1 + 4.25 - 8), 8.5 + 0.5 * (2 + 3.25 - 8.5), 6.5 + 0.5 * (3 - 6.5)]
    np.testing.assert_allclose(model.policy.q_table[:3, 1], expected)
    np.testing.assert_array_equal(model.policy.visit_counts[0, :, 1], [2, 2, 2, 0])


def test_where_time_runs_out_what_is_ahead_counts():
    env = TimeLimit(Corridor(length=9), 1)
    model = load_algorithm("qlearning")(env=env, learning_rate=1.0, gamma=0.5, seed=0, **GREEDY)
    model.policy.q_tables[0, 0, 1], model.policy.q_tables[0, 1] = 1.0, 8.0
    assert model.learn(1).policy.q_table[0, 1] == 1 + 0.5 * 8


def test_sarsa_does_what_it_committed_to():
    tracer = Tracer()
    uniform = {"exploration_decay": "constant", "exploration_initial_eps": 1.0}
    load_algorithm("sarsa")(env=Corridor(length=500), seed=0, **uniform).learn(300, callback=tracer)
    assert tracer.commitments[:-1] == tracer.actions[1:]
    assert set(tracer.actions) == {0, 1}


def test_q_learning_chooses_after_the_update():
    # Action 0 earns nothing, so that its value falls below that of action 1.
    tracer, settings = Tracer(), {"learning_rate": 0.5, "gamma": 0.0, "initial_q": 1.0}
    model = load_algorithm("qlearning")(
        env=Corridor(), tie_breaking="first", seed=0, **settings, **GREEDY
    )
    model.learn(2, callback=tracer)
    assert tracer.actions == (0, 1)


# --- optimism ------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("name", "settings", "value"),
    [
        ("qlearning", {"initial_q": 5.0}, 5),
        ("qlearning_ucb", {"value_bound": 7.0}, 7),
        ("qlearning_ucb", {}, 2),  # rewards of at most 1 come to 1 / (1 - gamma) at most
        ("r_max", {"value_bound": 3.0}, 3),
    ],
)
def test_tables_begin_where_they_are_told_to(name, settings, value):
    make = partial(load_algorithm(name), env="Taxi-v4", gamma=0.5, seed=0)
    assert (make(**settings).policy.q_table == value).all()
    if name == "qlearning":
        drawn = make(initial_q_std=2.0, **settings).policy.q_table
        # 3000 entries: mean and standard deviation within four standard errors.
        assert drawn.mean() == pytest.approx(5, abs=4 * 2 / 3000**0.5)
        assert drawn.std() == pytest.approx(2, abs=4 * 2 / 6000**0.5)


# --- Dyna-Q --------------------------------------------------------------------------------------


def test_planning_repeats_the_update():
    """Only one pair is known: one real update and three imagined ones, from 0 towards 2 + 4."""
    fed = Fed("dyna_q", [[0, 0], [4, 8]], planning_steps=3, learning_rate=0.1)
    assert fed.step(0, 1, 2, 1)[0, 1] == pytest.approx(6 * (1 - 0.9**4), rel=1e-14)
    assert fed.agent.mean_td_error == 6  # of the real one
    assert fed.agent.policy.visit_counts[0].tolist() == [[0, 1], [0, 0]]


def test_sample_averages_count_real_visits():
    fed = Fed("dyna_q", [[0]], planning_steps=2, learning_rate="sample_average")
    for n, reward in enumerate((4.0, 1.0), start=1):
        before = fed.table[0, 0]
        # The last outcome thrice, with a step size of 1/N.
        expected = reward + (before - reward) * (1 - 1 / n) ** 3
        assert fed.step(0, 0, reward, 0, "terminated")[0, 0] == pytest.approx(expected)


def test_the_model_holds_the_last_outcomes():
    fed = Fed("dyna_q", np.zeros((3, 1)), planning_steps=0, outcomes_kept=2)
    for reward, next_obs, end in ((1, 1, ""), (2, 2, "terminated"), (3, 0, "")):
        fed.step(0, 0, reward, next_obs, end)
    model = fed.agent.policy.model
    assert model.rewards[0, 0].tolist() == [3, 2]
    assert model.next_obs[0, 0].tolist() == [0, 2]
    assert model.terminated[0, 0].tolist() == [False, True]
    assert (model.counts.ravel().tolist(), model.n_pairs.tolist()) == ([3, 0, 0], [1])


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


def test_what_was_not_tried_for_long_is_worth_more():
    """Action 1 of state 0 is never tried: it stays, earns nothing, and its bonus grows by sqrt."""
    settings = {"gamma": 0.0, "kappa": 0.5, "learning_rate": 1.0}
    fed = Fed("dyna_q_plus", [[0, 0]], planning_steps=40, **settings)
    for step in range(1, 6):
        # Of the action that was tried just now no time has passed.
        table = fed.step(0, 0, 3, 0, "terminated")
        assert table[0].tolist() == [3, 0.5 * np.sqrt(step)]
    assert fed.step(0, 1, 7, 0, "terminated")[0].tolist() == [3 + 0.5 * np.sqrt(1), 7]
    model = fed.agent.policy.model
    assert model.pairs.tolist() == [0, 1]
    assert (model.tried_at.tolist(), model.time.tolist()) == ([[5, 6]], [6])
    # Only planning earns the bonus.
    fed = Fed("dyna_q_plus", [[0, 0]], planning_steps=0, **settings)
    assert fed.step(0, 0, 3, 0, "terminated").tolist() == [[3, 0]]


MAZE = {"desc": ["S.#", "..G"], "step_reward": 0, "shelf_reward": 0, "goal_reward": 1}


@pytest.mark.parametrize(
    ("name", "settings"), [("dyna_q", {}), ("prioritized_sweeping", {"threshold": 0.0})]
)
def test_much_planning_ends_in_the_optimum(name, settings):
    """All pairs of a small maze were tried: their values are those of the best policy, exactly."""
    env = make_vec_env("Warehouse-v0", seed=0, env_kwargs=MAZE)
    uniform = {"exploration_decay": "constant", "exploration_initial_eps": 1.0}
    settings = {"planning_steps": 50, "learning_rate": 1.0, **uniform, **settings}
    agent = load_algorithm(name)(env=env, seed=0, gamma=0.9, **settings).learn(1500)
    model = transition_model(gym.make("Warehouse-v0", **MAZE))
    tried = agent.policy.model.counts > 0
    assert tried[model.reachable].all()
    expected = value_iteration(model, 0.9).action_values
    np.testing.assert_allclose(agent.policy.q_table[tried], expected[tried], atol=1e-12)


# --- prioritised sweeping ------------------------------------------------------------------------


def chain(planning_steps, **settings):
    """Three states in a row, met one after the other; only the last step earns something."""
    settings = {"planning_steps": planning_steps, "learning_rate": 1.0, **settings}
    fed = Fed("prioritized_sweeping", np.zeros((4, 1)), **settings)
    fed.step(0, 0, 0, 1)
    fed.step(1, 0, 0, 2)
    assert not fed.agent.policy.model.n_queued.any()
    return fed, fed.step(2, 0, 8, 3, "terminated")[:, 0].tolist()


def test_news_of_the_goal_runs_backwards():
    fed, values = chain(5)
    assert values == [2, 4, 8, 0]
    assert fed.agent.mean_td_error == 8
    assert fed.agent.policy.visit_counts.ravel().tolist() == [1, 1, 1, 0]
    fed, values = chain(2)
    assert values == [0, 4, 8, 0]
    # The first state is next: its error is half of 4.
    model = fed.agent.policy.model
    assert (model.n_queued[0], model.queue[0], model.urgency[0]) == (1, 0, 2)
    assert fed.step(2, 0, 8, 3, "terminated")[0, 0] == 2
    assert not model.n_queued.any()


def test_small_errors_are_left():
    thresholds = {3.0: 0, 2.0: 0, 1.9: 2}
    assert {t: chain(5, threshold=t)[1][0] for t in thresholds} == thresholds


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


def test_a_changed_outcome_changes_what_leads_where():
    fed = Fed("prioritized_sweeping", np.zeros((3, 2)), planning_steps=0)
    for action in (0, 1):
        fed.step(action, 0, 0, 2)
    fed.step(1, 1, 0, 2)
    model = fed.agent.policy.model
    assert model.first_into.tolist() == [NONE, NONE, 3]
    fed.step(1, 0, 0, 0)  # from the middle of the list
    assert model.first_into.tolist() == [2, NONE, 3]
    assert (model.behind[3], model.before[0]) == (0, 3)
    fed.step(1, 1, 0, 2, "terminated")  # the first of it
    assert model.first_into.tolist() == [2, NONE, 0]


# --- R-max ---------------------------------------------------------------------------------------


def test_r_max_by_hand():
    fed = Fed("r_max", np.full((2, 2), 10.0), known_after=2, value_bound=10.0)
    assert (fed.step(0, 0, 1, 0) == 10).all()
    assert fed.agent.mean_td_error == abs(1 + 0.5 * 10 - 10)
    # Once back, once on: 0.5 * (1 + .5 V(0)) + 0.5 * (3 + .5 V(1)), where both are worth 10.
    assert fed.step(0, 0, 3, 1).tolist() == [[7, 10], [10, 10]]
    # The other action ends the episode: V(0) = max(Q(0, 0), 4), Q(0, 0) = 4.5 + .25 V(0) = 6.
    fed.step(0, 1, 4, 1, "terminated")
    np.testing.assert_allclose(fed.step(0, 1, 4, 1, "terminated"), [[6, 4], [10, 10]], atol=1e-4)
    # What is known is known: nothing more is counted.
    fed.step(0, 1, 400, 0)
    assert fed.agent.policy.model.counts.tolist() == [[2, 2], [0, 0]]
    assert fed.agent.policy.visit_counts[0].tolist() == [[2, 3], [0, 0]]


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.999, 0.9999])
def test_r_max_keeps_to_its_tolerance(gamma):
    fed = Fed("r_max", [[0]], gamma=gamma, known_after=1, tolerance=1e-4)
    assert fed.step(0, 0, 0.5, 0)[0, 0] == pytest.approx(0.5 / (1 - gamma), abs=1e-4)


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


def test_a_model_of_another_shape_is_refused():
    agent = load_algorithm("dyna_q")(env="FrozenLake-v1", engine="interpreted")
    agent.policy.model_rewards = th.zeros(16, 4, 2, dtype=th.float64)
    with pytest.raises(ValueError, match=r"model_rewards must be of shape \(16, 4, 1\)"):
        agent.learn(10)

"""Returns over several steps: n-step targets, traces and Monte Carlo, against the book's boxes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env

import rl_yardstick.envs  # noqa: F401  # registers the environments
from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.exploration import EPSILON_GREEDY, action_probabilities
from tests.agents.hand_fed import ENDS, N_ACTIONS, N_STATES, SHARES, Fed, episodes, greedy, tables

GAMMA, ALPHA = 0.75, 0.25
USUAL = {"gamma": GAMMA, "learning_rate": ALPHA}


def assert_close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def textbook_table(table, steps, end, n, ahead, backed_up):
    """The table after an episode that ends in state 0, by the boxes of chapter 7.

    Args:
        ahead: value of (table, state, action), where a target ends.
        backed_up: value of (table, state, action, later return), where it goes on.
    """
    table, total = np.array(table, dtype=float), len(steps)
    for time in range(total + n - 1):
        if time == total - 1:
            last = 0, greedy(table, 0)
        start = time - n + 1
        if start < 0:
            continue
        stop = min(start + n, total)
        later = 0.0
        if stop < total or end == "truncated":
            later = ahead(table, *(steps[stop][:2] if stop < total else last))
        for k in range(stop - 1, start - 1, -1):
            if k < stop - 1:
                later = backed_up(table, *steps[k + 1][:2], later)
            later = steps[k][2] + GAMMA * later
        table[steps[start][:2]] += ALPHA * (later - table[steps[start][:2]])
    return table


@settings(max_examples=25)
@given(table=tables(), steps=episodes(), end=ENDS, n=st.integers(1, 5))
def test_n_step_sarsa(table, steps, end, n):
    fed = Fed("n_step_sarsa", table, n_steps=n, **USUAL)
    for _ in range(2):  # nothing is left over from the first episode
        before = fed.table.copy()
        taken = fed.committed_episode(steps, end)
        values = lambda table, *place: table[place]  # noqa: E731
        later = lambda table, state, action, later: later  # noqa: E731
        assert_close(fed.table, textbook_table(before, taken, end, n, values, later))


@settings(max_examples=25)
@given(table=tables(), steps=episodes(), end=ENDS, n=st.integers(1, 5), epsilon=SHARES)
@pytest.mark.parametrize("target_policy", ["exploring", "greedy"])
def test_tree_backup(table, steps, end, n, epsilon, target_policy):
    def policy(table, state):
        if target_policy == "greedy":
            # Tied actions are worth the same: any share of them gives the same mean.
            return np.eye(len(table[state]))[greedy(table, state)]
        return action_probabilities(EPSILON_GREEDY, table, epsilon, random_ties=False)[state]

    def mean(table, state, action):
        return policy(table, state) @ table[state]

    def tree(table, state, action, later):
        shares = policy(table, state)
        if target_policy == "greedy" and table[state, action] == table[state].max():
            shares = np.eye(len(shares))[action]
        leaves = [shares[b] * table[state, b] for b in range(len(shares)) if b != action]
        return sum(leaves) + shares[action] * later

    own = {"n_steps": n, "target_policy": target_policy}
    fed = Fed("n_step_tree_backup", table, epsilon, **USUAL, **own)
    for _ in range(2):
        expected = textbook_table(fed.table, steps, end, n, mean, tree)
        fed.episode(steps, end)
        assert_close(fed.table, expected)


TRACES = ("sarsa_lambda", "q_lambda")


def ahead(table, steps, k, end):
    """What the step after the k-th is worth; both agents take a best action's value here."""
    if k + 1 < len(steps):
        return table[steps[k + 1][0]].max()
    return table[0].max() if end == "truncated" else 0.0


def is_cut(name, table, state, action):
    return name == "q_lambda" and table[state, action] < table[state].max()


def by_the_box(name, table, steps, end, decay, trace_type):
    """The table after an episode, with a trace for each entry."""
    table, traces = np.array(table, dtype=float), np.zeros((N_STATES, N_ACTIONS))
    for k, (state, action, reward) in enumerate(steps):
        traces *= 0.0 if is_cut(name, table, state, action) else GAMMA * decay
        traces[state, action] = 1 + (trace_type == "accumulating") * traces[state, action]
        td_error = reward + GAMMA * ahead(table, steps, k, end) - table[state, action]
        table += ALPHA * td_error * traces
    return table


def lambda_return(steps, values, decay, start, horizon):
    """From step ``start``, with values of the states after each step, up to the horizon."""
    total, discounted, weight = 0.0, 0.0, 1.0
    for k in range(start, horizon):
        discounted += GAMMA ** (k - start) * steps[k][2]
        target = discounted + GAMMA ** (k - start + 1) * values[k]
        total += weight * (1.0 if k == horizon - 1 else 1.0 - decay) * target
        weight *= decay
    return total


def by_online_lambda_returns(name, table, steps, end, decay, step_sizes):
    """The table after an episode, all of whose updates, since a cut, are done anew each step."""
    now = np.array(table, dtype=float)
    first, start, values = 0, now.copy(), []
    for k, (state, action, _) in enumerate(steps):
        if is_cut(name, now, state, action):
            first, start = k, now.copy()
        values.append(ahead(now, steps, k, end))
        now = start.copy()
        for j in range(first, k + 1):
            error = lambda_return(steps, values, decay, j, k + 1) - now[steps[j][:2]]
            now[steps[j][:2]] += step_sizes[j] * error
    return now


def taken_by(fed, name, steps, end):
    if name == "sarsa_lambda":
        return fed.committed_episode(steps, end)
    fed.episode(steps, end)
    return steps


@settings(max_examples=25)
@given(table=tables(), steps=episodes(), end=ENDS, decay=SHARES)
@pytest.mark.parametrize("trace_type", ["accumulating", "replacing"])
@pytest.mark.parametrize("name", TRACES)
def test_traces_of_the_box(name, trace_type, table, steps, end, decay):
    fed = Fed(name, table, trace_type=trace_type, trace_decay=decay, **USUAL)
    for _ in range(2):
        before = fed.table.copy()
        taken = taken_by(fed, name, steps, end)
        assert_close(fed.table, by_the_box(name, before, taken, end, decay, trace_type))


@settings(max_examples=25)
@given(table=tables(), steps=episodes(), end=ENDS, decay=SHARES)
# With a step size of 3 traces become negative.
@pytest.mark.parametrize("learning_rate", [ALPHA, 3.0, "sample_average"])
@pytest.mark.parametrize("name", TRACES)
def test_dutch_traces_are_the_online_lambda_return(name, learning_rate, table, steps, end, decay):
    own = {"learning_rate": learning_rate, "gamma": GAMMA, "trace_decay": decay}
    fed = Fed(name, table, trace_type="dutch", **own)
    counts = fed.agent.policy.visit_counts.numpy()[0]
    for _ in range(2):
        before, visits, sizes = fed.table.copy(), counts.copy(), []
        taken = taken_by(fed, name, steps, end)
        for state, action, _ in taken:
            visits[state, action] += 1
            is_average = learning_rate == "sample_average"
            sizes.append(1 / visits[state, action] if is_average else learning_rate)
        assert_close(fed.table, by_online_lambda_returns(name, before, taken, end, decay, sizes))


@settings(max_examples=25)
@given(table=tables(), steps=episodes(), end=ENDS)
@pytest.mark.parametrize("every_visit", [False, True])
@pytest.mark.parametrize("learning_rate", [ALPHA, "sample_average"])
def test_returns_after_visits(table, steps, end, every_visit, learning_rate):
    own = {"gamma": GAMMA, "learning_rate": learning_rate, "every_visit": every_visit}
    fed = Fed("monte_carlo", table, **own)
    expected, visits = fed.table.copy(), np.zeros_like(fed.table)
    for _ in range(2):
        # The best value in state 0 stands for what was cut off.
        later, pairs = expected[0].max() if end == "truncated" else 0.0, [s[:2] for s in steps]
        for k in reversed(range(len(steps))):
            later = steps[k][2] + GAMMA * later
            if every_visit or pairs.index(pairs[k]) == k:
                visits[pairs[k]] += 1
                size = ALPHA if learning_rate == ALPHA else 1 / visits[pairs[k]]
                expected[pairs[k]] += size * (later - expected[pairs[k]])
        fed.episode(steps, end)
        assert_close(fed.table, expected)
    assert np.array_equal(fed.agent.policy.visit_counts.numpy()[0], visits)


class Weighed(Fed):
    """Off-policy Monte Carlo, which chooses by itself; or is told that it chose something."""

    def __init__(self, table, epsilon, **settings):
        super().__init__("off_policy_monte_carlo", table, epsilon, **settings)

    def act(self, obs):
        self.agent._last_obs = np.array([obs])
        return int(self.agent._choose_actions()[0])

    def tell(self, **fields):
        """What the agent has noted of its last choice: action and probability."""
        for name, value in fields.items():
            self.agent._workspace_for(self.agent.rng, 1).fields[name][:] = value


@settings(max_examples=25)
@given(
    table=tables(),
    places=st.lists(st.integers(0, N_STATES - 1), min_size=1, max_size=8),
    end=ENDS,
    seed=st.integers(0, 1000),
)
def test_weighted_importance_sampling(table, places, end, seed):
    """The box of section 5.7, with the probabilities that the agent acts by."""
    fed = Weighed(table, 0.8, gamma=GAMMA, seed=seed)  # off the greedy policy rather often
    expected, weights = fed.table.copy(), np.zeros_like(fed.table)
    for _ in range(3):
        policy, steps = fed.agent.action_probabilities(), []
        later = expected[0].max() if end == "truncated" else 0.0
        for k, place in enumerate(places):
            steps.append((place, fed.act(place), (k * 7) % 5 - 2))
            is_last = k == len(places) - 1
            fed.step(*steps[-1], 0 if is_last else places[k + 1], end if is_last else "")
        weight = 1.0
        for state, action, reward in reversed(steps):
            later = reward + GAMMA * later
            weights[state, action] += weight
            share = weight / weights[state, action]
            expected[state, action] += share * (later - expected[state, action])
            if action != greedy(expected, state):
                break
            weight /= policy[state, action]
        assert_close(fed.table, expected)
        assert_close(fed.agent.policy.weights[0].numpy(), weights)


def test_off_policy_monte_carlo_by_hand():
    """Epsilon is a half, so that a greedy action has a probability of 3/4, another one of 1/4."""
    fed = Weighed(np.zeros((2, 2)), 0.5)
    sums = fed.agent.policy.weights.numpy()[0]

    def learn(second_action, second_reward, second_probability):
        fed.tell(probability=0.75)
        fed.step(0, 0, 1, 1)
        fed.tell(probability=second_probability)
        return fed.step(1, second_action, second_reward, 0, "terminated").tolist()

    # What led to the end by an action that is the best one now counts four times.
    assert learn(1, 4, 0.25) == [[3, 0], [0, 4]]
    assert sums.tolist() == [[4, 0], [0, 1]]
    # 4 + 1/2 * (1 - 4); 3 + (4/3) / (4 + 4/3) * (1.5 - 3).
    assert learn(1, 1, 0.75) == [[pytest.approx(2.625), 0], [0, 2.5]]
    # An action that the greedy policy would not have taken tells nothing of what came before.
    assert learn(0, 0, 0.25) == [[pytest.approx(2.625), 0], [0, 2.5]]
    np.testing.assert_allclose(sums, [[16 / 3, 0], [1, 2]], rtol=1e-15)


@pytest.mark.parametrize(
    ("name", "one_step", "own", "shared"),
    [
        ("n_step_sarsa", "sarsa", {"n_steps": 1}, {"exploration": "gaussian_noise"}),
        ("n_step_tree_backup", "qlearning", {"n_steps": 1, "target_policy": "greedy"}, {}),
        ("sarsa_lambda", "sarsa", {"trace_decay": 0.0, "trace_type": "dutch"}, {}),
        ("q_lambda", "qlearning", {"trace_decay": 0.0, "trace_type": "replacing"}, {}),
        ("dyna_q", "qlearning", {"planning_steps": 0}, {"learning_rate": "sample_average"}),
    ],
)
def test_at_one_end_it_is_the_one_step_agent_to_the_bit(name, one_step, own, shared):
    models = []
    for each, settings_ in ((name, {**own, **shared}), (one_step, shared)):
        env = make_vec_env("FrozenLake-v1", 3, seed=3)
        models.append(load_algorithm(each)(env=env, seed=1, **settings_).learn(1500))
    model, other = models
    assert np.array_equal(model.policy.q_table, other.policy.q_table)
    assert np.array_equal(model.policy.visit_counts, other.policy.visit_counts)
    assert model.mean_td_error == other.mean_td_error
    assert model.rng.bit_generator.state == other.rng.bit_generator.state

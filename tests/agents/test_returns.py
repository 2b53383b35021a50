"""Returns over several steps: n-step targets, traces and Monte Carlo, against the book's boxes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rl_yardstick.agents.common.exploration import EPSILON_GREEDY, action_probabilities
from tests.agents.hand_fed import ENDS, EPISODES, N_ACTIONS, N_STATES, SHARES, TABLES, Fed

GAMMA, ALPHA = 0.75, 0.25
USUAL = {"gamma": GAMMA, "learning_rate": ALPHA}


def assert_close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def textbook_table(table, steps, end, n, ahead, backed_up):
    """The table after an episode that ends in state 0, by the boxes of chapter 7.

    A target ends in a value ``ahead``, and goes through values ``backed_up`` from later ones.
    """
    table, total = np.array(table, dtype=float), len(steps)
    for time in range(total + n - 1):
        if time == total - 1:
            last = 0, table[0].argmax()
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
@given(table=TABLES, steps=EPISODES, end=ENDS, n=st.integers(1, 5))
def test_n_step_sarsa(table, steps, end, n):
    fed = Fed("n_step_sarsa", table, n_steps=n, **USUAL)
    for _ in range(2):  # nothing is left over from the first episode
        before = fed.table.copy()
        taken = fed.episode(steps, end, commits=True)
        values = lambda table, *place: table[place]  # noqa: E731
        later = lambda table, state, action, later: later  # noqa: E731
        assert_close(fed.table, textbook_table(before, taken, end, n, values, later))


@settings(max_examples=25)
@given(table=TABLES, steps=EPISODES, end=ENDS, n=st.integers(1, 5), epsilon=SHARES)
@pytest.mark.parametrize("target_policy", ["exploring", "greedy"])
def test_tree_backup(table, steps, end, n, epsilon, target_policy):
    def policy(table, state):
        if target_policy == "greedy":
            # Tied actions are worth the same: any share of them gives the same mean.
            return np.eye(len(table[state]))[table[state].argmax()]
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
            later = values[k]
            for i in reversed(range(j, k + 1)):
                later = steps[i][2] + GAMMA * (values[i] + decay * (later - values[i]))
            now[steps[j][:2]] += step_sizes[j] * (later - now[steps[j][:2]])
    return now


@settings(max_examples=25)
@given(table=TABLES, steps=EPISODES, end=ENDS, decay=SHARES)
@pytest.mark.parametrize("trace_type", ["accumulating", "replacing"])
@pytest.mark.parametrize("name", TRACES)
def test_traces_of_the_box(name, trace_type, table, steps, end, decay):
    fed = Fed(name, table, trace_type=trace_type, trace_decay=decay, **USUAL)
    for _ in range(2):
        before = fed.table.copy()
        taken = fed.episode(steps, end, commits=name == "sarsa_lambda")
        assert_close(fed.table, by_the_box(name, before, taken, end, decay, trace_type))


@settings(max_examples=25)
@given(table=TABLES, steps=EPISODES, end=ENDS, decay=SHARES)
# With a step size of 3 traces become negative.
@pytest.mark.parametrize("learning_rate", [ALPHA, 3.0, "sample_average"])
@pytest.mark.parametrize("name", TRACES)
def test_dutch_traces_are_the_online_lambda_return(name, learning_rate, table, steps, end, decay):
    own = {"learning_rate": learning_rate, "gamma": GAMMA, "trace_decay": decay}
    fed = Fed(name, table, trace_type="dutch", **own)
    counts = fed.agent.policy.visit_counts.numpy()[0]
    for _ in range(2):
        before, visits, sizes = fed.table.copy(), counts.copy(), []
        taken = fed.episode(steps, end, commits=name == "sarsa_lambda")
        for state, action, _ in taken:
            visits[state, action] += 1
            is_average = learning_rate == "sample_average"
            sizes.append(1 / visits[state, action] if is_average else learning_rate)
        assert_close(fed.table, by_online_lambda_returns(name, before, taken, end, decay, sizes))


@settings(max_examples=25)
@given(table=TABLES, steps=EPISODES, end=ENDS)
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


@settings(max_examples=25)
@given(table=TABLES, steps=EPISODES, end=ENDS, seed=st.integers(0, 1000))
def test_weighted_importance_sampling(table, steps, end, seed):
    """The box of section 5.7, with the probabilities that the agent acts by."""
    own = {"gamma": GAMMA, "seed": seed}
    fed = Fed("off_policy_monte_carlo", table, 0.8, **own)  # often off the greedy policy
    expected, weights = fed.table.copy(), np.zeros_like(fed.table)
    ends = [*(("", step[0]) for step in steps[1:]), (end, 0)]
    for _ in range(3):
        policy, weight, taken = fed.agent.action_probabilities(), 1.0, []
        later = expected[0].max() if end == "truncated" else 0.0
        for (state, _, reward), (ended, following) in zip(steps, ends, strict=True):
            fed.agent._last_obs = np.array([state])  # from where it chooses by itself
            taken.append((state, int(fed.agent._choose_actions()[0]), reward))
            fed.step(*taken[-1], following, ended)
        for state, action, reward in reversed(taken):
            later = reward + GAMMA * later
            weights[state, action] += weight
            share = weight / weights[state, action]
            expected[state, action] += share * (later - expected[state, action])
            if action != expected[state].argmax():
                break
            weight /= policy[state, action]
        assert_close(fed.table, expected)
        assert_close(fed.agent.policy.weights[0].numpy(), weights)


def test_off_policy_monte_carlo_by_hand():
    """Epsilon is a half, so that a greedy action has a probability of 3/4, another one of 1/4."""
    fed = Fed("off_policy_monte_carlo", np.zeros((2, 2)), 0.5)
    sums = fed.agent.policy.weights.numpy()[0]
    noted = fed.agent._workspace_for(fed.agent.rng, 1).fields["probability"]  # of its last choice

    def learn(second_action, second_reward, second_probability):
        noted[:] = 0.75
        fed.step(0, 0, 1, 1)
        noted[:] = second_probability
        return fed.step(1, second_action, second_reward, 0, "terminated").tolist()

    # What led to the end by an action that is the best one now counts four times.
    assert learn(1, 4, 0.25) == [[3, 0], [0, 4]]
    assert sums.tolist() == [[4, 0], [0, 1]]
    # 4 + 1/2 * (1 - 4); 3 + (4/3) / (4 + 4/3) * (1.5 - 3).
    assert learn(1, 1, 0.75) == [[pytest.approx(2.625), 0], [0, 2.5]]
    # An action that the greedy policy would not have taken tells nothing of what came before.
    assert learn(0, 0, 0.25) == [[pytest.approx(2.625), 0], [0, 2.5]]
    np.testing.assert_allclose(sums, [[16 / 3, 0], [1, 2]], rtol=1e-15)

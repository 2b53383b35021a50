"""Explanations of agents whose tables are written by hand, and sums that hold for all agents."""

import re

import pytest
import torch as th

from rl_yardstick.diagnosis.explanation import explanation
from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.mdp import policy_iteration
from rl_yardstick.pipeline.evaluation.exact import exact_evaluator
from rl_yardstick.pipeline.training import make_agent
from rl_yardstick.report.words import why_lines
from tests.pipeline.short_runs import spec_of

LAKE = {"env_kwargs": {"is_slippery": False, "max_episode_steps": 30}}


def explained(algo, env_id, entry=None, change=None, steps=0):
    """The explanation of an agent after some steps, and after ``change(agent)``."""
    discount = {} if algo in ("random", "optimal") else {"gamma": 0.95}
    spec = spec_of(algo, env_id, {**discount, **(entry or {})})
    agent = make_agent(spec, None)
    if steps:
        if algo not in ("ppo", "optimal"):  # too few to compile for
            agent.engine = "interpreted"
        agent.learn(steps)
    if change is not None:
        change(agent)
    return explanation(spec, agent, exact_evaluator(spec))


def with_values(discount, wrong=None, untried=()):
    """Write the exact optimal values into a table, with what is to be wrong with them."""

    def write(agent):
        model = transition_model(agent.get_env().envs[0])
        values = policy_iteration(model, discount).action_values
        for (state, action), value in (wrong or {}).items():
            values[state, action] = value
        agent.policy.q_tables[:] = th.from_numpy(values)
        agent.policy.visit_counts[:] = 10
        for state, action in untried:
            agent.policy.visit_counts[:, state, action] = 0

    return write


FORGOTTEN = {(14, 2): 0.0, (13, 2): 0.0, (9, 1): 0.0, (10, 1): 0.0}
SLIPS = {"env_kwargs": {"slip": 0.1}, "gamma": 0.5}
EXPLORES = {"exploration_initial_eps": 0.1, "exploration_final_eps": 0.1, "gamma": 1.0}
TREE = "n_step_tree_backup"
ICE, CLIFF, CORRIDOR = "FrozenLake-v1", "CliffWalking-v1", "ShortCorridor-v0"
# Agent, environment and entry; what is written into its table, or steps of training; a part, and
# its loss, where None is the whole gap.
PARTS = [
    # At cell 14 the goal lies to the right, and it goes up.
    ("qlearning", ICE, LAKE, with_values(0.95, {(14, 3): 1.01}), "look-ahead", 1.0),
    # All values are zero: one look ahead sees the goal from cell 14 alone.
    ("qlearning", ICE, LAKE, lambda agent: agent.policy.visit_counts.fill_(10), "not settled", 1.0),
    # The only way out of cell 14, and the values behind it, without a trial.
    ("qlearning", ICE, LAKE, with_values(0.95, FORGOTTEN, [(14, 2)]), "never tried", 1.0),
    # At discount 0.5 a slipping robot does better to stand still than to risk a shelf.
    ("qlearning", "Warehouse-v0", SLIPS, with_values(0.5), "objective", None),
    # Sutton and Barto, example 6.6: with epsilon 0.1 the best is the safer way, here of 15.
    ("sarsa", CLIFF, EXPLORES, 2000, "exploring", 2.0),
    (TREE, CLIFF, {**EXPLORES, "target_policy": "exploring"}, 2000, "exploring", 2.0),
    (TREE, CLIFF, {**EXPLORES, "target_policy": "greedy"}, 2000, "exploring", 0.0),
    ("qlearning", CORRIDOR, {}, 100, "not observable", 8.657),
]


@pytest.mark.parametrize(("algo", "env_id", "entry", "done", "name", "loss"), PARTS)
def test_each_handicap_has_its_part(algo, env_id, entry, done, name, loss):
    steps = done if isinstance(done, int) else 0
    found = explained(algo, env_id, entry, None if steps else done, steps)
    losses = {part.name: part.loss for part in found.parts}
    loss = found.gap if loss is None else loss
    assert losses.get(name, 0.0) == pytest.approx(loss, abs=0.001)


def test_an_optimal_agent_has_nothing_to_explain():
    found = explained("qlearning", ICE, LAKE, with_values(0.95))
    assert (found.is_optimal, found.is_concentrated) == (True, False)
    assert why_lines(found) == ["optimal: it returns 1, and no policy returns more"]


def test_one_wrong_action_is_named_with_what_mending_it_regains():
    """From cell 14 the goal lies to the right; the agent walks up for ever, between 14 and 10."""
    found = explained("qlearning", ICE, LAKE, with_values(0.95, {(14, 3): 1.01}))
    assert found.gap == pytest.approx(1.0)
    assert found.is_caught
    assert "circles between" in found.ending
    assert found.repairs == (("row 4, column 3", pytest.approx(1.0)),)
    assert found.road == (
        "on the best road of 6 states it reaches the end from 0; its last wrong turn is at "
        "row 4, column 3: up, where right is best"
    )
    assert found.own_gap == pytest.approx(0.95**5)  # six moves, the last of which pays


def test_a_loss_in_few_states_is_told_state_by_state():
    found = explained("qlearning", ICE, {"gamma": 0.999}, with_values(0.999, {(14, 0): 9.0}))
    assert found.is_concentrated
    states = [line for line in why_lines(found) if line.startswith("  row")]
    assert re.match("  row 4, column 3: 97% of the gap, .*; it does left, where down i", states[0])
    assert re.match("  row 1, column 3: 3% of the gap, ", states[1])


def test_a_discount_that_hides_the_goal_is_to_be_raised():
    found = explained("qlearning", "Warehouse-v0", SLIPS, with_values(0.5))
    assert found.own_gap == pytest.approx(0.0, abs=1e-9)
    assert found.proposals[0] == "gamma:auto"


def test_states_that_look_alike_are_named():
    found = explained("qlearning", CORRIDOR, steps=100)
    assert found.looks_alike
    assert found.repairs == ()
    assert "cannot tell 3 states apart" in why_lines(found)[-1]


SMALL = {"policy_kwargs": {"net_arch": [16]}, "n_steps": 64, "batch_size": 64}


@pytest.mark.parametrize(
    ("algo", "entry", "steps"),
    [("r_max", {}, 500), ("semi_gradient_q", {}, 1000), ("ppo", SMALL, 128)],
)
def test_parts_and_states_sum_to_the_gap_of_any_agent(algo, entry, steps):
    found = explained(algo, ICE, entry, steps=steps)
    assert found.losses.sum() == pytest.approx(found.gap, rel=1e-9)
    assert sum(part.loss for part in found.parts) == pytest.approx(found.gap, rel=1e-9)
    assert len(why_lines(found)) <= 12
    assert found.as_data()["gap"] == found.gap


def test_the_random_agent_and_planners_have_no_parts_but_states():
    random = explained("random", ICE)
    assert random.parts == ()
    assert random.losses.sum() == pytest.approx(random.gap, rel=1e-9)
    assert explained("optimal", ICE, steps=1).is_optimal

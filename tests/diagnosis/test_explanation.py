"""Explanations of agents whose tables are written by hand, and sums that hold for all agents."""

import re

import pytest
import torch as th

from rl_yardstick.diagnosis.explanation import explanation, parting
from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.mdp import policy_iteration
from rl_yardstick.pipeline.evaluation.exact import exact_evaluator
from rl_yardstick.pipeline.training import make_agent
from rl_yardstick.report.why import parting_lines, why_lines
from tests.pipeline.short_runs import spec_of

LAKE = {"env_kwargs": {"is_slippery": False, "max_episode_steps": 30}}
SMALL = {"policy_kwargs": {"net_arch": [16]}}


def run_of(algo, env_id, entry=None):
    """The spec of a run, and its agent before it has learnt anything."""
    has_discount = algo not in ("random", "optimal")
    spec = spec_of(algo, env_id, {**({"gamma": 0.95} if has_discount else {}), **(entry or {})})
    return spec, make_agent(spec, None)


def explained(algo, env_id, entry=None, change=None, steps=0):
    """The explanation of an agent after some steps, and after ``change(agent)``."""
    spec, agent = run_of(algo, env_id, entry)
    if steps:
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


def parts_of(found):
    return {part.name: part.loss for part in found.parts}


def test_an_optimal_agent_has_nothing_to_explain():
    found = explained("qlearning", "FrozenLake-v1", LAKE, with_values(0.95))
    assert found.is_optimal
    assert why_lines(found) == ["optimal: it returns 1, and no policy returns more"]


def test_one_wrong_action_is_named_with_what_mending_it_regains():
    """From cell 14 the goal lies to the right; the agent walks up for ever, between 14 and 10."""
    wrong = {(14, 3): 1.01}
    found = explained("qlearning", "FrozenLake-v1", LAKE, with_values(0.95, wrong))
    assert found.gap == pytest.approx(1.0)
    assert parts_of(found)["look-ahead"] == pytest.approx(1.0)
    assert found.is_caught
    assert "circles between" in found.ending
    assert [(name, pytest.approx(value)) for name, value in found.repairs] == [
        ("row 4, column 3", pytest.approx(1.0))
    ]
    assert found.road == (
        "on the best road of 6 states it reaches the end from 0; its last wrong turn is at "
        "row 4, column 3: up, where right is best"
    )
    assert found.own_gap == pytest.approx(0.95**5)  # six moves, the last of which pays


def test_values_that_have_not_come_to_the_start_are_not_settled():
    """All zero, though every pair was tried: one look ahead sees the goal from cell 14 alone."""
    found = explained(
        "qlearning", "FrozenLake-v1", LAKE, lambda agent: agent.policy.visit_counts.fill_(10)
    )
    parts = {name: loss for name, loss in parts_of(found).items() if abs(loss) > 1e-9}
    assert parts == {"not settled": pytest.approx(1.0)}
    assert not found.is_concentrated  # it is caught where it starts


def test_a_loss_in_few_states_is_told_state_by_state():
    entry = {"gamma": 0.999}
    found = explained("qlearning", "FrozenLake-v1", entry, with_values(0.999, {(14, 0): 9.0}))
    assert found.is_concentrated
    states = [line for line in why_lines(found) if line.startswith("  row")]
    assert re.match(
        "  row 4, column 3: 97% of the gap, .*; it does left, where down is b", states[0]
    )
    assert re.match("  row 1, column 3: 3% of the gap, ", states[1])
    assert not explained("qlearning", "FrozenLake-v1", LAKE, with_values(0.95)).is_concentrated


def test_an_action_that_was_never_tried_is_told_from_one_of_wrong_value():
    """The only way out of the corridor at cell 14, and the values behind it, without a trial."""
    untried = [(14, 2)]
    wrong = {(14, 2): 0.0, (13, 2): 0.0, (9, 1): 0.0, (10, 1): 0.0}
    found = explained("qlearning", "FrozenLake-v1", LAKE, with_values(0.95, wrong, untried))
    assert parts_of(found)["never tried"] == pytest.approx(1.0)


def test_a_discount_that_hides_the_goal_is_the_objective_s_part():
    """At discount 0.5 a slipping robot does better to stand still than to risk a shelf."""
    entry = {"env_kwargs": {"slip": 0.1}, "gamma": 0.5}
    found = explained("qlearning", "Warehouse-v0", entry, with_values(0.5))
    assert parts_of(found)["objective"] == pytest.approx(found.gap)
    assert found.own_gap == pytest.approx(0.0, abs=1e-9)
    assert found.proposals[0] == "gamma:auto"


@pytest.mark.parametrize(
    ("algo", "more", "lost"),
    [
        ("sarsa", {}, 2.0),
        ("n_step_tree_backup", {"target_policy": "exploring"}, 2.0),
        ("n_step_tree_backup", {"target_policy": "greedy"}, 0.0),
    ],
)
def test_what_learns_while_exploring_walks_around_the_cliff(algo, more, lost):
    """Sutton and Barto, example 6.6: with epsilon 0.1 the best is the safer way, here of 15."""
    entry = {"exploration_initial_eps": 0.1, "exploration_final_eps": 0.1, "gamma": 1.0, **more}
    found = explained(algo, "CliffWalking-v1", entry, steps=2000)
    assert found.optimum == pytest.approx(-13)
    assert parts_of(found).get("exploring", 0.0) == pytest.approx(lost)


def test_what_cannot_be_observed_is_a_part_of_its_own():
    found = explained("qlearning", "ShortCorridor-v0", steps=100)
    assert parts_of(found)["not observable"] == pytest.approx(8.657, abs=0.001)
    assert found.looks_alike
    assert found.repairs == ()
    assert "cannot tell 3 states apart" in why_lines(found)[-1]


@pytest.mark.parametrize(
    ("algo", "env_id", "entry", "steps"),
    [
        ("r_max", "FrozenLake-v1", {}, 500),
        ("semi_gradient_q", "FrozenLake-v1", {}, 1000),
        ("ppo", "FrozenLake-v1", {**SMALL, "n_steps": 64, "batch_size": 64}, 128),
    ],
)
def test_parts_and_states_sum_to_the_gap_of_any_agent(algo, env_id, entry, steps):
    found = explained(algo, env_id, entry, steps=steps)
    assert found.losses.sum() == pytest.approx(found.gap, rel=1e-9)
    assert sum(part.loss for part in found.parts) == pytest.approx(found.gap, rel=1e-9)
    assert len(why_lines(found)) <= 12
    assert found.as_data()["gap"] == found.gap


def test_the_random_agent_and_planners_have_no_parts_but_states():
    random = explained("random", "FrozenLake-v1")
    assert random.parts == ()
    assert random.losses.sum() == pytest.approx(random.gap, rel=1e-9)
    assert explained("optimal", "FrozenLake-v1", steps=1).is_optimal


def test_two_agents_part_where_one_of_them_goes_wrong():
    sides = []
    for wrong in ({}, {(14, 3): 1.01}):
        spec, agent = run_of("qlearning", "FrozenLake-v1", LAKE)
        with_values(0.95, wrong)(agent)
        sides.append((spec, agent, exact_evaluator(spec)))
    found = parting(*reversed(sides))
    assert (found.difference, found.met) == (pytest.approx(1), pytest.approx(1))
    assert [place.name for place in found.places] == ["row 4, column 3"]
    assert found.names == ("qlearning 2", "qlearning 1")
    assert parting_lines(found)[1].endswith("qlearning 2 does right, qlearning 1 up")
    assert parting(sides[0], sides[0]).places == ()

"""Proposals for runs that fail for a planted cause, and proposals that must not be made."""

import numpy as np
import pytest

from rl_yardstick.diagnosis.explanation import explanation
from rl_yardstick.experiments.results import Tried
from rl_yardstick.experiments.study import AS_IT_IS, SHIPPED, intervention_study
from rl_yardstick.pipeline.evaluation.exact import exact_evaluator
from rl_yardstick.pipeline.settings import override, parse_assignments, read_entry, read_spec
from rl_yardstick.pipeline.training import make_agent
from rl_yardstick.report.words import tried_lines
from tests.pipeline.short_runs import LAKE, WAREHOUSE, spec_of

TAXI, CLIFF = "Taxi-v4", "CliffWalking-v1"
NO_EPSILON = {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0, "initial_q": 0.0}
BOLD = {"exploration_initial_eps": 0.5, "n_timesteps": 40_000}
HASTY = {"train_env_kwargs": {"max_episode_steps": 10}}
SHORT_SIGHTED = {"gamma": 0.5, "env_kwargs": {"slip": 0.1}, "n_timesteps": 200_000}
LOW = {"initial_q": -500.0, "exploration_initial_eps": 0.1}
CLIPPED = {"train_env_wrapper": {"gymnasium.wrappers.ClipReward": {"max_reward": 0.0}}}

# Agent, environment, changes of the shipped settings, and how the right changes begin.
CAUSES = [
    ("qlearning", TAXI, {"n_timesteps": 10_000}, ("n_timesteps:",)),
    ("qlearning", TAXI, {"learning_rate": 0.002}, ("learning_rate:exp_0.5", "n_timesteps:")),
    ("qlearning", LAKE, {"learning_rate": 0.9}, ("learning_rate:exp_0.5",)),
    ("qlearning", LAKE, NO_EPSILON, ("exploration_initial_eps:1", "initial_q:1")),
    ("sarsa", CLIFF, BOLD, ("exploration_decay:linear", "exploration_initial_eps:0.1")),
    ("qlearning", WAREHOUSE, SHORT_SIGHTED, ("gamma:auto",)),
    ("qlearning", LAKE, CLIPPED, ("train_env_wrapper:null",)),
    ("qlearning", WAREHOUSE, HASTY, ("train_env_kwargs:null",)),
    ("qlearning", TAXI, {**LOW, "n_timesteps": 100_000}, ("initial_q:0",)),
    ("dqn", LAKE, {"learning_rate": 0.3, "n_timesteps": 10_000}, ("learning_rate:lin_0.001",)),
]


HIGH = {"initial_q": 1000.0, "learning_rate": 0.05, "n_timesteps": 100_000}

# Likewise, and the settings that none of the changes may touch.
INNOCENT = [
    ("qlearning", TAXI, {"n_timesteps": 10_000}, ("learning_rate", "gamma", "exploration")),
    ("qlearning", LAKE, NO_EPSILON, ("n_timesteps", "learning_rate")),
    ("qlearning", WAREHOUSE, HASTY, ("n_timesteps", "initial_q", "exploration")),
]


def shipped(algo, env_id, change):
    """The spec with shipped settings, but for a change."""
    entry = {**override(read_entry(algo, env_id), change), "engine": "auto"}
    return read_spec(algo, env_id, entry, device="cpu")


def explained(algo, env_id, change=None, steps=None):
    """Of an agent with shipped settings, but for a change, after its training."""
    spec = shipped(algo, env_id, change or {})
    agent = make_agent(spec, None)
    if steps and algo != "ppo":  # too few to compile for
        agent.engine = "interpreted"
    agent.learn(steps or spec.n_timesteps)
    return explanation(spec, agent, exact_evaluator(spec))


def proposals_of(algo, env_id, change=None, steps=None):
    """The proposals of `explained`."""
    return explained(algo, env_id, change, steps).proposals


def test_the_right_change_is_first_or_second_for_eight_of_ten_causes():
    missed = {}
    for algo, env_id, change, right in CAUSES:
        found = proposals_of(algo, env_id, change)
        if not any(one.startswith(right) for one in found[:2]):
            missed[right] = found
    assert len(missed) <= 2, missed


@pytest.mark.parametrize(
    ("algo", "env_id", "change", "absent"),
    [
        # epsilon stays at its initial value, and gamma is 1
        ("sarsa", CLIFF, {}, ("exploration_final_eps:", "gamma:", "train_env")),
        ("qlearning", LAKE, {}, ("gamma:",)),  # gamma: auto is what it has
        ("qlearning", LAKE, {"exploration": "boltzmann"}, ("exploration_",)),
        ("r_max", LAKE, {}, ("learning_rate:", "exploration_", "initial_q:")),
        ("semi_gradient_q", LAKE, {}, ("temperature:", "policy_kwargs:")),
        ("reinforce", LAKE, {}, ("exploration_", "policy_kwargs:")),
    ],
)
def test_every_proposal_changes_a_setting_that_the_agent_has(algo, env_id, change, absent):
    found = proposals_of(algo, env_id, change, steps=50)
    assert found
    assert not [one for one in found if one.startswith(absent)]
    before = shipped(algo, env_id, change).hyperparams
    for one in found:
        typed = parse_assignments(one.split(), "--test")
        after = read_spec(algo, env_id, override(before, typed))
        assert after.hyperparams != before, one
        make_agent(after, None)  # it accepts these settings


@pytest.mark.parametrize(("algo", "env_id", "change", "innocent"), INNOCENT)
def test_no_proposal_blames_settings_that_are_as_shipped(algo, env_id, change, innocent):
    found = proposals_of(algo, env_id, change)
    assert found
    assert not [one for one in " ".join(found).split() if one.startswith(innocent)], found


@pytest.mark.parametrize(
    ("algo", "env_id", "change"),
    [
        ("qlearning", TAXI, HIGH),
        ("qlearning", TAXI, {"learning_rate": 0.005, "gamma": 0.5}),  # two causes at once
        ("qlearning", LAKE, {"learning_rate": 0.9, "gamma": 0.6}),
    ],
)
def test_the_first_or_the_second_proposal_mends_a_cause(algo, env_id, change):
    before = explained(algo, env_id, change)
    budget = {key: change[key] for key in ("n_timesteps",) if key in change}
    good = explained(algo, env_id, budget).value
    typed = [parse_assignments(one.split(), "--test") for one in before.proposals[:2]]
    after = [explained(algo, env_id, override(change, one)).value for one in typed]
    assert max(after) >= (before.value + good) / 2
    assert before.value not in after


def test_networks_are_also_offered_a_larger_one_and_the_unchanged_task():
    found = proposals_of("ppo", TAXI, {"n_steps": 8, "batch_size": 64}, steps=128)
    assert "policy_kwargs:dict(net_arch=[256,256])" in found
    assert "train_env_wrapper:null" in found
    assert {one.partition(":")[0] for one in found} >= {"n_timesteps", "learning_rate", "ent_coef"}
    assert sum(one.startswith("learning_rate:") for one in found) == 2


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ([0.04] * 4, "no change closes 5% of the gap"),
        ([1, 0, 0, 0], "no change closes 5% of the gap"),  # one seed of four
        ([1, 1, 0, 0], "lr:1 helps most: it closes 50% of the gap on average, in 2 of 4 seeds"),
        ([np.nan] * 4, "no change closes 5% of the gap"),
    ],
)
def test_a_remedy_closes_a_twentieth_of_the_gap_in_half_of_the_seeds(change, word):
    rows = {SHIPPED: [0.0] * 4, AS_IT_IS: [0.0] * 4, "lr:1": change}
    lines = tried_lines([Tried(name, np.array(row)) for name, row in rows.items()], optimum=1.0)
    assert lines[3].startswith(word)


def test_changes_and_models_of_one_name_have_folders_of_their_own():
    spec = spec_of("qlearning", LAKE, {"gamma": 0.5})
    study = intervention_study(spec, ["tie_breaking:first"], "lake")
    assert study.agents[0].label == "tie_breaking:first"  # the likeliest is trained first
    other = spec_of("qlearning", LAKE, {"gamma": 0.6})
    assert intervention_study(other, ["gamma:auto"], "lake").name != study.name
    assert intervention_study(spec, ["gamma:auto"], "lake").name == study.name

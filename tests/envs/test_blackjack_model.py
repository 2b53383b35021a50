"""Blackjack's exact model against the book and what is published."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.toy_text.blackjack import BlackjackEnv

import envs  # noqa: F401 (registers the environments)
from agents import load_algorithm
from agents.compiled.worlds import NotCompilable, compile_envs
from envs.blackjack_model import blackjack_observations, natural_state, state_of
from envs.known_models import observations_of_states, success_outcomes, transition_model
from envs.wrappers import FlattenToDiscrete
from mdp import policy_return, value_iteration

SUTTON, NATURAL = {"sab": True}, {"sab": False, "natural": True}
PUBLISHED = [(SUTTON, -0.0431), (NATURAL, -0.0257), ({"sab": False, "natural": False}, -0.0466)]
STICK, HIT = 0, 1


def model_of(rules):
    return transition_model(FlattenToDiscrete(gym.make("Blackjack-v1", **rules)))


def test_the_optimum_is_the_one_that_is_published():
    for rules, published in PUBLISHED:
        model = model_of(rules)
        found = policy_return(model, value_iteration(model, 1.0).policy, None).expected_return
        assert found == pytest.approx(published, abs=5e-5)


def test_the_policy_is_that_of_figure_5_2():
    policy = value_iteration(model_of(SUTTON), 1.0).policy
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
    flat = observations_of_states(FlattenToDiscrete(gym.make("Blackjack-v1")))
    assert flat[:704].tolist() == list(range(704))
    assert flat[natural_state(3)] == state_of(21, 3, True)
    env = gym.make("Blackjack-v1", natural=True, sab=False)
    model, wins = transition_model(env), success_outcomes(env)
    assert set(model.reward[wins].tolist()) == {1.0, 1.5}
    # With this rule a natural that beats the dealer's 20 pays more, and no other hand.
    paid = (model.reward == 1.5) & (model.prob > 0)
    assert sorted(set(np.nonzero(paid)[0].tolist())) == [natural_state(up) for up in range(1, 11)]


class Cheating(BlackjackEnv):
    """Its steps may do anything."""


def test_another_blackjack_is_not_believed_and_none_is_compiled():
    changed = BlackjackEnv()
    changed.step = lambda action: None
    assert transition_model(Cheating()) is transition_model(changed) is None
    agent = load_algorithm("qlearning")(env=FlattenToDiscrete(gym.make("Blackjack-v1")))
    with pytest.raises(NotCompilable, match="does not continue from the state"):
        compile_envs(agent.env)

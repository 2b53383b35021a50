"""Blackjack's exact model against the book, a recursion on hands of cards, and played hands."""

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.toy_text.blackjack import BlackjackEnv, cmp, is_natural, score, sum_hand

import envs  # noqa: F401 (registers the environments)
from agents import load_algorithm
from agents.compiled.worlds import NotCompilable, compile_envs
from envs.blackjack_model import blackjack_observations, natural_state, state_of
from envs.known_models import observations_of_states, success_outcomes, transition_model
from envs.wrappers import FlattenToDiscrete
from mdp import policy_return, value_iteration

CARDS = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 10, 10, 10]
SUTTON, USUAL = {"sab": True}, {"sab": False}
PUBLISHED = [(SUTTON, -0.0431), (USUAL, -0.0466)]
STICK, HIT = 0, 1


@cache
def dealers_hands(hand):
    """Chances of (score, natural) at the end, by playing all hands out with Gymnasium's functions.

    The order of cards does not count: hands are sorted.
    """
    if len(hand) > 1 and sum_hand(list(hand)) >= 17:
        return {(score(list(hand)), is_natural(list(hand))): 1.0}
    found = {}
    for card in CARDS:
        for result, chance in dealers_hands(tuple(sorted((*hand, card)))).items():
            found[result] = found.get(result, 0) + chance / 13
    return found


def value_of_sticking(hand, dealer, rules):
    total, natural = 0.0, is_natural(list(hand))
    for (theirs, their_natural), chance in dealers_hands((dealer,)).items():
        reward = cmp(score(list(hand)), theirs)
        if rules["sab"] and natural and not their_natural:
            reward = 1.0
        total += chance * reward
    return total


def values_of_game(rules):
    """The expected reward of the best and of random actions, over hands as lists of cards."""

    @cache
    def value(hand, dealer):
        if sum_hand(list(hand)) > 21:
            return -1.0, -1.0
        after = [value(tuple(sorted((*hand, card))), dealer) for card in CARDS]
        hit, hit_at_random = (sum(each) / 13 for each in zip(*after, strict=True))
        stick = value_of_sticking(hand, dealer, rules)
        return max(hit, stick), (hit_at_random + stick) / 2

    deals = [(tuple(sorted((one, two))), up) for one in CARDS for two in CARDS for up in CARDS]
    return np.mean([value(hand, dealer) for hand, dealer in deals], axis=0)


def model_of(rules):
    return transition_model(FlattenToDiscrete(gym.make("Blackjack-v1", **rules)))


@pytest.mark.parametrize(("rules", "published"), PUBLISHED, ids=["as in the book", "as usual"])
def test_values_are_those_of_a_recursion_over_hands_of_cards(rules, published):
    model = model_of(rules)
    found = policy_return(model, value_iteration(model, 1.0).policy, None).expected_return
    best, at_random = values_of_game(rules)
    assert found == pytest.approx(best, abs=1e-12)
    assert found == pytest.approx(published, abs=5e-5)
    # Random actions come to all states.
    even = policy_return(model, np.full((model.n_states, 2), 0.5), None).expected_return
    assert even == pytest.approx(at_random, abs=1e-12)


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

"""Blackjack's exact model against the book, a recursion on hands of cards, and played hands."""

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.toy_text.blackjack import BlackjackEnv, cmp, is_natural, score, sum_hand

import envs  # noqa: F401 (registers the environments)
from agents import load_algorithm
from agents.compiled.worlds import NotCompilable, compile_envs
from envs.blackjack_model import blackjack_model, blackjack_observations, natural_state, state_of
from envs.known_models import (
    observations_of_states,
    success_outcomes,
    transition_model,
)
from envs.wrappers import FlattenToDiscrete
from mdp import policy_return, value_iteration

CARDS = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 10, 10, 10]
RULES = [{"sab": True}, {"sab": False, "natural": True}, {"sab": False, "natural": False}]
STICK, HIT = 0, 1


@cache
def dealers_hands(hand: tuple[int, ...]) -> dict[tuple[int, bool], float]:
    """Chances of (score, natural) at the end, by playing all hands out with Gymnasium's functions.

    The order of cards does not count: hands are sorted.
    """
    if len(hand) > 1 and sum_hand(list(hand)) >= 17:
        return {(score(list(hand)), is_natural(list(hand))): 1.0}
    found: dict[tuple[int, bool], float] = {}
    for card in CARDS:
        for result, chance in dealers_hands(tuple(sorted((*hand, card)))).items():
            found[result] = found.get(result, 0) + chance / 13
    return found


def value_of_sticking(hand: tuple[int, ...], dealer: int, rules: dict[str, bool]) -> float:
    total = 0.0
    for (theirs, their_natural), chance in dealers_hands((dealer,)).items():
        reward = cmp(score(list(hand)), theirs)
        if rules["sab"]:
            reward = 1.0 if is_natural(list(hand)) and not their_natural else reward
        elif rules["natural"] and is_natural(list(hand)) and reward == 1.0:
            reward = 1.5
        total += chance * reward
    return total


def value_of_game(rules: dict[str, bool]) -> float:
    """The best expected reward, over hands as lists of cards."""
    rules = {"natural": False, **rules}

    @cache
    def best(hand: tuple[int, ...], dealer: int) -> float:
        if sum_hand(list(hand)) > 21:
            return -1.0
        hit = sum(best(tuple(sorted((*hand, card))), dealer) for card in CARDS) / 13
        return max(hit, value_of_sticking(hand, dealer, rules))

    deals = [(tuple(sorted((one, two))), up) for one in CARDS for two in CARDS for up in CARDS]
    return float(np.mean([best(hand, dealer) for hand, dealer in deals]))


def model_of(rules: dict[str, bool]):
    model = transition_model(FlattenToDiscrete(gym.make("Blackjack-v1", **rules)))
    assert model is not None
    return model


def start_value(rules: dict[str, bool]) -> float:
    model = model_of(rules)
    return policy_return(model, value_iteration(model, 1.0).policy, None).expected_return


@pytest.mark.parametrize(
    ("rules", "published"), list(zip(RULES, [-0.0431, -0.0257, -0.0466], strict=True))
)
def test_the_optimum_is_that_of_a_recursion_over_hands_of_cards(rules, published) -> None:
    found = start_value(rules)
    assert found == pytest.approx(value_of_game(rules), abs=1e-12)
    assert found == pytest.approx(published, abs=5e-5)


def test_the_policy_is_that_of_figure_5_2() -> None:
    plan = value_iteration(model_of({"sab": True}), 1.0)
    # Without a usable ace stick from this sum on, by the dealer's card: ace, 2, 3, ..., 10.
    hard = [17, 13, 13, 12, 12, 12, 17, 17, 17, 17]
    soft = [19, 18, 18, 18, 18, 18, 18, 18, 19, 19]
    for dealer in range(1, 11):
        for total in range(11, 22):
            wanted = STICK if total >= hard[dealer - 1] else HIT
            assert plan.policy[state_of(total, dealer, False)] == wanted
        for total in range(12, 22):
            wanted = STICK if total >= soft[dealer - 1] else HIT
            assert plan.policy[state_of(total, dealer, True)] == wanted
        assert plan.policy[natural_state(dealer)] == STICK
        assert all(plan.policy[state_of(total, dealer, False)] == HIT for total in range(4, 11))


@pytest.mark.parametrize("rules", RULES[:2])
def test_starts_and_steps_of_played_hands_have_the_models_chances(rules) -> None:
    env = gym.make("Blackjack-v1", **rules).unwrapped
    assert isinstance(env, BlackjackEnv)
    model, n = blackjack_model(env), 10_000
    starts, reached, tried = np.zeros(model.n_states), {}, {}
    env.reset(seed=1)
    for i in range(n):
        obs, _ = env.reset()
        natural = is_natural(env.player)
        state = natural_state(obs[1]) if natural else state_of(*obs)
        starts[state] += 1
        obs, reward, terminated, _, _ = env.step(i % 2)
        after = state_of(*obs)
        if i % 2 == STICK and natural:
            after = state
        key = (state, i % 2, after, reward, terminated)
        reached[key] = reached.get(key, 0) + 1
        tried[state, i % 2] = tried.get((state, i % 2), 0) + 1
    assert (np.abs(starts - n * model.initial) <= 5 * np.sqrt(n * model.initial) + 3).all()
    for (state, action, after, reward, terminated), count in reached.items():
        same = (model.next_state[state, action] == after) & (model.reward[state, action] == reward)
        same &= model.terminated[state, action] == terminated
        chance = model.prob[state, action][same].sum()
        times = tried[state, action]
        assert chance > 0
        assert abs(count - times * chance) <= 5 * np.sqrt(times * chance * (1 - chance)) + 5


def hands_played(policy: np.ndarray, n: int, seed: int) -> np.ndarray:
    """Rewards of many hands at once under the sab rules, dealt card by card."""
    rng, cards = np.random.default_rng(seed), np.array(CARDS)

    def value(low: np.ndarray, aces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        usable = aces & (low + 10 <= 21)
        return low + 10 * usable, usable

    def draw(low, aces, who):
        card = cards[rng.integers(13, size=n)]
        return low + card * who, aces | ((card == 1) & who)

    everybody = np.ones(n, bool)
    show = cards[rng.integers(13, size=n)]
    dealer = draw(show, show == 1, everybody)
    player = draw(*draw(np.zeros(n, int), np.zeros(n, bool), everybody), everybody)
    dealers_natural, natural = (value(*hand)[0] == 21 for hand in (dealer, player))
    playing = everybody.copy()
    while playing.any():
        total, usable = value(*player)
        state = np.where(total <= 21, (total * 11 + show) * 2 + usable, 0)
        playing &= (total <= 21) & (policy[state] == HIT)
        player = draw(*player, playing)
    while (drawing := value(*dealer)[0] < 17).any():
        dealer = draw(*dealer, drawing)
    ours, theirs = (np.where(value(*hand)[0] > 21, 0, value(*hand)[0]) for hand in (player, dealer))
    rewards = np.sign(ours - theirs).astype(float)
    rewards[natural & ~dealers_natural] = 1
    return np.where(ours == 0, -1.0, rewards)


def test_two_million_hands_earn_the_optimum() -> None:
    policy = value_iteration(model_of({"sab": True}), 1.0).policy
    rewards = hands_played(policy, 2_000_000, seed=7)
    error = rewards.std() / np.sqrt(len(rewards))
    assert rewards.mean() == pytest.approx(start_value({"sab": True}), abs=3 * error)


def test_a_natural_looks_as_any_21_does() -> None:
    seen = blackjack_observations()
    assert seen[natural_state(10)].tolist() == seen[state_of(21, 10, True)].tolist() == [21, 10, 1]
    flat = observations_of_states(FlattenToDiscrete(gym.make("Blackjack-v1")))
    assert flat[:704].tolist() == list(range(704))
    assert flat[natural_state(3)] == state_of(21, 3, True)


def test_wins_are_successes() -> None:
    env = gym.make("Blackjack-v1", natural=True, sab=False)
    success, model = success_outcomes(env), transition_model(env)
    assert set(model.reward[success].tolist()) == {1.0, 1.5}


def test_agents_that_plan_take_it_and_compiled_training_does_not() -> None:
    env = FlattenToDiscrete(gym.make("Blackjack-v1", max_episode_steps=100))
    agent = load_algorithm("optimal")(env=env, seed=0).learn(10)
    assert agent.predict(state_of(13, 2, False))[0] == STICK
    with pytest.raises(NotCompilable, match="does not go on from where its attribute s is set"):
        compile_envs(load_algorithm("qlearning")(env=env).env)


class Cheating(BlackjackEnv):
    """Its steps may do anything."""


def test_another_blackjack_is_not_believed() -> None:
    assert transition_model(Cheating()) is None
    env = BlackjackEnv()
    env.step = lambda action: None  # type: ignore[method-assign]
    assert transition_model(env) is None

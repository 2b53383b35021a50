"""The exact model of Gymnasium's Blackjack.

Cards come from an infinite deck, so only the hand matters, and the dealer's hidden card is
equivalent to one drawn later. The distribution of the dealer's final sum follows by recursion from
the visible card.

A state is an observation, numbered as `FlattenToDiscrete` does: (sum, dealer's card, usable ace).
In addition, for each card of the dealer there is a state with a natural, an ace and a ten as dealt:
it is observed as any 21 with a usable ace, and may be worth more.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, lru_cache

import numpy as np

from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel

SIZES = (32, 11, 2)  # the number of values of each part of the observation
N_OBSERVED = 32 * 11 * 2
N_STATES = N_OBSERVED + 11
STICK, HIT = 0, 1
ACE = 1
# The values 1 to 10 of a card; ten, jack, queen and king count 10.
CARD_PROB = np.array([0.0, *[1 / 13] * 9, 4 / 13])
CARDS = range(1, 11)
DEALER_STANDS = 17
MOST = 21


def blackjack_observations() -> Ints:
    """The observation of each state, its three parts side by side, shape (S, 3)."""
    seen = np.stack(np.unravel_index(np.arange(N_OBSERVED), SIZES), axis=1)
    naturals = np.array([(MOST, dealer, 1) for dealer in range(11)])
    return np.concatenate([seen, naturals])


def state_of(total: int, dealer: int, usable_ace: bool) -> int:
    """The number of a state that is no natural."""
    return (total * SIZES[1] + dealer) * SIZES[2] + usable_ace


def natural_state(dealer: int) -> int:
    """The number of the state with a natural."""
    return N_OBSERVED + dealer


def hand_after(total: int, usable_ace: bool, card: int) -> tuple[int, bool]:
    """Sum and usable ace of a hand that takes another card; above 21 it is bust."""
    low = total - 10 * usable_ace + card
    usable = (usable_ace or card == ACE) and low + 10 <= MOST
    return low + 10 * usable, usable


@cache
def dealer_sums(total: int, usable_ace: bool) -> tuple[float, ...]:
    """Probabilities of the dealer's final sums 17, 18, ..., 21 and of going bust, in that order."""
    if total >= DEALER_STANDS:
        return tuple(float(min(total, MOST + 1) == final) for final in range(DEALER_STANDS, 23))
    later = [dealer_sums(*hand_after(total, usable_ace, card)) for card in CARDS]
    return tuple((CARD_PROB[1:] @ np.array(later)).tolist())


def sticking(total: int, dealer: int, natural: str | None) -> tuple[float, float, float, float]:
    """Probabilities of the rewards 1.5, 1, 0 and -1 when the player sticks on a sum.

    ``natural`` is "wins" if a natural beats all but another natural, "pays" if a win with it pays
    1.5, and None if it counts as any 21, or the hand is no natural.
    """
    if natural == "wins":
        # The other card of the dealer's natural.
        tie = CARD_PROB[11 - dealer] if dealer in {ACE, 10} else 0.0
        return 0.0, float(1 - tie), float(tie), 0.0
    *stands, bust = dealer_sums(*hand_after(0, False, dealer))
    finals = range(DEALER_STANDS, MOST + 1)
    win = bust + sum(p for p, final in zip(stands, finals, strict=True) if final < total)
    draw = sum(p for p, final in zip(stands, finals, strict=True) if final == total)
    lose = sum(p for p, final in zip(stands, finals, strict=True) if final > total)
    return (win, 0.0, draw, lose) if natural == "pays" else (0.0, win, draw, lose)


@lru_cache(maxsize=4)
def blackjack_model(pays: bool, sab: bool) -> TransitionModel:
    """The exact dynamics of a Blackjack environment, by its rules `natural` and `sab`."""
    shape = (N_STATES, 2, 10)
    prob, reward = np.zeros(shape), np.zeros(shape)
    # Unreachable states, and those of finished games, lead to themselves.
    prob[..., 0] = 1
    next_state = np.broadcast_to(np.arange(N_STATES)[:, None, None], shape).copy()
    terminated = np.ones(shape, np.bool_)
    for state, hand, dealer, is_natural in _decisions():
        brings = ("wins" if sab else "pays" if pays else None) if is_natural else None
        prob[state, STICK, :4] = sticking(hand[0], dealer, brings)
        reward[state, STICK, :4] = 1.5, 1, 0, -1
        prob[state, HIT] = CARD_PROB[1:]
        for k, card in enumerate(CARDS):
            after, usable = hand_after(*hand, card)
            next_state[state, HIT, k] = state_of(after, dealer, usable)
            reward[state, HIT, k] = -1.0 if after > MOST else 0.0
            terminated[state, HIT, k] = after > MOST
    return TransitionModel(prob, next_state, reward, terminated, _starts())


def _decisions() -> Iterator[tuple[int, tuple[int, bool], int, bool]]:
    """Where the player has to decide: state, hand, dealer's card, and whether it is a natural."""
    hands = [(total, False) for total in range(4, 22)] + [(total, True) for total in range(12, 22)]
    for dealer in CARDS:
        for hand in hands:
            yield state_of(hand[0], dealer, hand[1]), hand, dealer, False
        yield natural_state(dealer), (MOST, True), dealer, True


def _starts() -> Floats:
    initial = np.zeros(N_STATES)
    for dealer in CARDS:
        for one in CARDS:
            for two in CARDS:
                hand = hand_after(*hand_after(0, False, one), two)
                is_natural = hand[0] == MOST
                state = natural_state(dealer) if is_natural else state_of(hand[0], dealer, hand[1])
                initial[state] += CARD_PROB[dealer] * CARD_PROB[one] * CARD_PROB[two]
    return initial

"""Blackjack: a policy's values (figure 5.1, example 5.1) and the best policy (5.2, example 5.3).

    python docs/textbook/blackjack.py              # 500,000 episodes each: three minutes
    python docs/textbook/blackjack.py 5.1

5.1 has the values of sticking only on 20 and 21, by Monte Carlo; we add the exact values, which the
book does not have. 5.2 has the policy of Monte Carlo control. The book uses exploring starts, and
averages all returns. We use epsilon-greedy exploration, with epsilon falling from 0.3 to 0.05, and
a falling step size, which forgets returns of early, worse policies. We add the optimal policy.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from _figures import Statement, agent_on, learn_episodes, main
from gymnasium import spaces
from matplotlib.figure import Figure
from stable_baselines3.common.utils import LinearSchedule

from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.envs.wrappers import FlattenToDiscrete
from rl_yardstick.mdp.evaluation import policy_return
from rl_yardstick.mdp.finite_horizon import finite_horizon_optimum
from rl_yardstick.mdp.graph import PolicyChain
from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel

FEW, MANY = 10_000, 500_000
STICK, HIT = 0, 1
STICKS_FROM = 20
PLAYER, DEALER = np.arange(12, 22), np.arange(1, 11)  # below 12, hitting is never worse
LONGEST = 25  # cards; no hand lasts so long


def game() -> gym.Env[Any, Any]:
    """Make Gymnasium's Blackjack with the book's rules and numbered observations."""
    return FlattenToDiscrete(gym.make("Blackjack-v1", sab=True))


def model() -> TransitionModel:
    """The exact model of `game`: one state for each observation, and eleven for naturals."""
    known = transition_model(game())
    assert known is not None
    return known


def observations() -> Ints:
    """Numbers of the plotted observations by usable ace, player, dealer, shape (2, 10, 10)."""
    ace, player, dealer = np.ix_(np.arange(2), PLAYER, DEALER)
    return np.asarray((player * 11 + dealer) * 2 + ace)


def stick_on_twenty(n_observations: int) -> Ints:
    """The policy of example 5.1: the action for each observation."""
    return np.where(np.arange(n_observations) // 22 >= STICKS_FROM, STICK, HIT)


class OnePolicy(gym.ObservationWrapper[Any, Any, Any]):
    """Has only one action, the one that ``policy`` takes, so that an agent only predicts."""

    def __init__(self, env: gym.Env[Any, Any], policy: Ints) -> None:
        super().__init__(env)
        self.policy = policy
        self.action_space = spaces.Discrete(1)
        self._obs = 0

    def observation(self, observation: int) -> int:
        """Store the observation for the policy."""
        self._obs = observation
        return observation

    def step(self, action: int) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take the policy's action."""
        return super().step(self.policy[self._obs])


def exact_values() -> Floats:
    """The policy's exact values of all states of the model, shape (S,); NaN if never visited."""
    blackjack = model()
    policy = stick_on_twenty(blackjack.n_states)  # naturals come after the observations
    chain = PolicyChain.build(blackjack, np.eye(2)[policy])
    values = np.full(blackjack.n_states, np.nan)
    values[chain.states] = chain.solve(chain.mean(chain.reward), 1.0)
    return values


def values_of_a_policy(n_episodes: int) -> tuple[Figure, list[Statement]]:
    """Figure 5.1."""
    policy, shown = stick_on_twenty(model().n_states - 11), observations()  # without naturals
    agent = agent_on(
        lambda: OnePolicy(game(), policy), "monte_carlo", 0, learning_rate="sample_average"
    )
    learn_episodes(agent, FEW)
    few = agent.policy.q_table[shown, 0]
    learn_episodes(agent, n_episodes - FEW)
    many, exact = agent.policy.q_table[shown, 0], exact_values()[shown]
    figure = Figure(figsize=(9, 6), layout="constrained")
    columns = {f"{FEW:,} episodes": few, f"{n_episodes:,} episodes": many, "exact": exact}
    for axes, (title, values) in zip(figure.subplots(2, 3).T, columns.items(), strict=True):
        for row, ace in enumerate(("usable ace", "no usable ace")):
            range_ = {"extent": (0.5, 10.5, 11.5, 21.5), "vmin": -1, "vmax": 1}
            mesh = axes[row].imshow(values[1 - row], origin="lower", cmap="coolwarm", **range_)
            axes[row].set(title=f"{ace}, {title}", xlabel="dealer shows", ylabel="player's sum")
            figure.colorbar(mesh, ax=axes[row], shrink=0.7)
    off, first = np.abs(many - exact), np.abs(few - exact)
    return figure, [
        Statement(
            "the values are very well approximated after 500,000 episodes",
            f"by {off.mean():.3f} in the mean, {off.max():.3f} at most",
            bool(off.mean() < 0.03),
        ),
        Statement(
            "with a usable ace they are less certain, since such states are rare",
            f"wrong by {first[1].mean():.3f} at first, without by {first[0].mean():.3f}",
            bool(first[1].mean() > first[0].mean()),
        ),
        Statement(
            "they jump up for the last two rows, where the policy sticks",
            f"without an ace {exact[0, -2].mean():.2f} at 20, {exact[0, -3].mean():.2f} at 19",
            bool((exact[:, -2] > exact[:, -3] + 0.5).all()),
        ),
        Statement(
            "and drop off where the dealer shows an ace",
            f"without an ace {exact[0, :-2, 0].mean():.2f}, {exact[0, :-2, 1:].mean():.2f} else",
            bool((exact[:, :, 0] < exact[:, :, 1]).all()),
        ),
    ]


def best_policy(n_episodes: int) -> tuple[Figure, list[Statement]]:
    """Figure 5.2."""
    agent = agent_on(
        game,
        "monte_carlo",
        0,
        learning_rate=LinearSchedule(0.01, 0.0, 1.0),
        exploration_initial_eps=0.3,
        exploration_final_eps=0.05,
        exploration_decay="linear",
        exploration_fraction=0.8,
    )
    learn_episodes(agent, n_episodes)
    shown, blackjack, actions = observations(), model(), agent.policy.q_table.argmax(axis=1)
    best = finite_horizon_optimum(blackjack, LONGEST).policy[0, : len(actions)].astype(np.int64)
    figure = Figure(figsize=(8, 6.4), layout="constrained")
    for axes, (title, policy) in zip(
        figure.subplots(2, 2).T, {"learnt": actions, "optimal": best}.items(), strict=True
    ):
        for row, ace in enumerate(("no usable ace", "usable ace")):
            axes[1 - row].imshow(
                policy[shown][row],
                origin="lower",
                extent=(DEALER[0] - 0.5, DEALER[-1] + 0.5, PLAYER[0] - 0.5, PLAYER[-1] + 0.5),
                vmin=-0.5,
                vmax=1.5,
                cmap="Pastel1",
            )
            axes[1 - row].set(title=f"{title}, {ace}", xlabel="dealer shows", ylabel="player's sum")
            axes[1 - row].text(5, 20, "stick", ha="center", va="center")
            axes[1 - row].text(8, 13, "hit", ha="center", va="center")
    differ = int((actions[shown] != best[shown]).sum())
    # A natural has the same observation as any other 21.
    seen = np.append(np.arange(len(actions)), (21 * 11 + np.arange(11)) * 2 + 1)
    played = [policy_return(blackjack, each[seen], LONGEST) for each in (best, actions)]
    optimum, reached = (each.expected_return for each in played)
    return figure, [
        Statement(
            "the optimal policy with a usable ace sticks on 19, and on 18 but for a 9, 10 or ace",
            "as by planning",
            bool((best[shown][1, 7:] == STICK).all())
            and [int(card) for card in DEALER[best[shown][1, 6] == HIT]] == [1, 9, 10],
        ),
        Statement(
            "Monte Carlo control finds it",
            f"but for {differ} of {actions[shown].size} cells, which cost "
            f"{optimum - reached:.4f} of {optimum:.4f}",
            differ <= 20 and optimum - reached < 0.005,
        ),
    ]


if __name__ == "__main__":
    main(__doc__, {"5.1": (values_of_a_policy, MANY), "5.2": (best_policy, MANY)})

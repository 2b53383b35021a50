"""Figure 5.1: values of sticking only on 20 and 21 in Blackjack, by Monte Carlo (example 5.1).

    python docs/textbook/figure_5_1.py              # 500,000 episodes, as in the book: a minute

We add the exact values, which the book does not have.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from _figures import Statement, agent_on, arguments, finish, learn_episodes
from gymnasium import spaces
from matplotlib.figure import Figure

from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.envs.wrappers import FlattenToDiscrete
from rl_yardstick.mdp.graph import PolicyChain
from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel

FEW, MANY = 10_000, 500_000
STICK, HIT = 0, 1
STICKS_FROM = 20
PLAYER, DEALER = np.arange(12, 22), np.arange(1, 11)  # below 12, hitting is never worse


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


def surfaces(axes: Any, values: Floats, title: str) -> None:
    """Draw values by the player's sum and the dealer's card, shape (10, 10)."""
    mesh = axes.imshow(
        values, origin="lower", extent=(0.5, 10.5, 11.5, 21.5), vmin=-1, vmax=1, cmap="coolwarm"
    )
    axes.set(title=title, xlabel="dealer shows", ylabel="player's sum")
    axes.figure.colorbar(mesh, ax=axes, shrink=0.7)


def exact_values() -> Floats:
    """The policy's exact values of all states of the model, shape (S,); NaN if never visited."""
    blackjack = model()
    policy = stick_on_twenty(blackjack.n_states)  # naturals come after the observations
    chain = PolicyChain.build(blackjack, np.eye(2)[policy])
    values = np.full(blackjack.n_states, np.nan)
    values[chain.states] = chain.solve(chain.mean(chain.reward), 1.0)
    return values


def main() -> None:
    """Draw the figure, and compare it with the book."""
    args = arguments("Figure 5.1 of Sutton and Barto: a policy's values in Blackjack.", MANY)
    policy, shown = stick_on_twenty(model().n_states - 11), observations()  # without naturals
    agent = agent_on(
        lambda: OnePolicy(game(), policy), "monte_carlo", 0, learning_rate="sample_average"
    )
    learn_episodes(agent, FEW)
    few = agent.policy.q_table[shown, 0]
    learn_episodes(agent, args.runs - FEW)
    many, exact = agent.policy.q_table[shown, 0], exact_values()[shown]
    figure = Figure(figsize=(9, 6), layout="constrained")
    columns = {f"{FEW:,} episodes": few, f"{args.runs:,} episodes": many, "exact": exact}
    for axes, (title, values) in zip(figure.subplots(2, 3).T, columns.items(), strict=True):
        surfaces(axes[0], values[1], f"usable ace, {title}")
        surfaces(axes[1], values[0], f"no usable ace, {title}")
    finish("figure_5_1", figure, args.folder, statements(few, many, exact))


def statements(few: Floats, many: Floats, exact: Floats) -> list[Statement]:
    """The book's statements on the surfaces, shapes (2, 10, 10)."""
    off = {"few": np.abs(few - exact), "many": np.abs(many - exact)}
    return [
        Statement(
            "the values are very well approximated after 500,000 episodes",
            f"by {off['many'].mean():.3f} in the mean, {off['many'].max():.3f} at most",
            bool(off["many"].mean() < 0.03),
        ),
        Statement(
            "with a usable ace they are less certain, since such states are rare",
            f"wrong by {off['few'][1].mean():.3f} at first, without by {off['few'][0].mean():.3f}",
            bool(off["few"][1].mean() > off["few"][0].mean()),
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


if __name__ == "__main__":
    main()

"""Figure 5.2: the optimal policy in Blackjack, found by Monte Carlo control (example 5.3).

    python docs/textbook/figure_5_2.py              # 500,000 episodes: two minutes

The book uses exploring starts, and averages all returns. We use epsilon-greedy exploration, with
epsilon falling from 0.3 to 0.05, and a falling step size, which forgets returns of early, worse
policies. We add the optimal policy, found by planning.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from _figures import Statement, agent_on, arguments, finish, learn_episodes
from figure_5_1 import DEALER, HIT, PLAYER, STICK, game, model, observations
from matplotlib.figure import Figure
from stable_baselines3.common.utils import LinearSchedule

from rl_yardstick.mdp.evaluation import policy_return
from rl_yardstick.mdp.finite_horizon import finite_horizon_optimum
from rl_yardstick.mdp.transition_model import Ints

N_EPISODES = 500_000
LONGEST = 25  # cards; no hand lasts so long
NAMES = {HIT: "hit", STICK: "stick"}


def learnt(n_episodes: int) -> Any:
    """Train Monte Carlo control for ``n_episodes``."""
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
    return agent


def by_state(actions: Ints) -> Ints:
    """Actions for all states of the model; a natural has the same observation as any other 21."""
    naturals = (21 * 11 + np.arange(11)) * 2 + 1
    return np.concatenate([actions, actions[naturals]])


def statements(actions: Ints, best: Ints) -> list[Statement]:
    """The book's statements on the actions for each observation."""
    blackjack, shown = model(), observations()
    differ = int((actions[shown] != best[shown]).sum())
    optimum = policy_return(blackjack, by_state(best), LONGEST).expected_return
    reached = policy_return(blackjack, by_state(actions), LONGEST).expected_return
    from_19 = best[shown][1, 7:]
    return [
        Statement(
            "the optimal policy with a usable ace sticks on 19, and on 18 but for a 9, 10 or ace",
            "as by planning",
            bool((from_19 == STICK).all())
            and [int(card) for card in DEALER[best[shown][1, 6] == HIT]] == [1, 9, 10],
        ),
        Statement(
            "Monte Carlo control finds it",
            f"but for {differ} of {actions[shown].size} cells, which cost "
            f"{optimum - reached:.4f} of {optimum:.4f}",
            differ <= 20 and optimum - reached < 0.005,
        ),
    ]


def main() -> None:
    """Draw the figure, and compare it with the book."""
    args = arguments("Figure 5.2 of Sutton and Barto: Blackjack's policy.", N_EPISODES)
    shown, blackjack = observations(), model()
    n_observed = blackjack.n_states - 11
    best = finite_horizon_optimum(blackjack, LONGEST).policy[0, :n_observed].astype(np.int64)
    actions = learnt(args.runs).policy.q_table.argmax(axis=1)
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
            axes[1 - row].text(5, 20, NAMES[STICK], ha="center", va="center")
            axes[1 - row].text(8, 13, NAMES[HIT], ha="center", va="center")
    finish("figure_5_2", figure, args.folder, statements(actions, best))


if __name__ == "__main__":
    main()

"""Figure 6.5: maximization bias of Q-learning and double Q-learning (section 6.7).

    python docs/textbook/figure_6_5.py              # 1,000 runs: two minutes; the book has 10,000

The plot has the share of runs that go left from A in each of the first 300 episodes. An
epsilon-greedy agent goes left in at least 5 % of the cases.
"""

from __future__ import annotations

import numpy as np
from _figures import Statement, agent_on, arguments, canvas, finish, learn_episodes

from rl_yardstick.mdp.transition_model import Floats

N_EPISODES = 300
LEFT = 2  # steps
LEAST = 0.05  # half of epsilon, for two actions
LABELS = {"qlearning": "Q-learning", "double_qlearning": "double Q-learning"}


def went_left(algo: str, seed: int) -> Floats:
    """Whether each episode of a run went left, which takes two steps, shape (N_EPISODES,)."""
    agent = agent_on("envs:MaximizationBias-v0", algo, seed, learning_rate=0.1, mask_actions=True)
    _, lengths = learn_episodes(agent, N_EPISODES)
    left: Floats = np.where(lengths == LEFT, 1.0, 0.0)
    return left


def main() -> None:
    """Draw the figure, and compare it with the book."""
    args = arguments("Figure 6.5 of Sutton and Barto: maximization bias.", 1000)
    figure, axes = canvas("Maximization bias", "episodes", "left from A, % of runs")
    shares = {}
    for algo, label in LABELS.items():
        runs = np.array([went_left(algo, seed) for seed in range(args.runs)])
        shares[algo] = runs.mean(axis=0)
        axes.plot(np.arange(1, N_EPISODES + 1), 100 * shares[algo], label=label)
    axes.axhline(100 * LEAST, color="grey", linestyle="--", label="least, by epsilon")
    axes.set_ylim(0, 100)
    axes.legend()
    single, double = shares["qlearning"], shares["double_qlearning"]
    finish("figure_6_5", figure, args.folder, statements(single, double))


def statements(single: Floats, double: Floats) -> list[Statement]:
    """The book's statements on the two curves, shapes (N_EPISODES,)."""
    late = slice(N_EPISODES - 50, None)
    return [
        Statement(
            "Q-learning begins by going left far more often than right",
            f"up to {single.max():.0%} of runs, in episode {single.argmax() + 1}",
            bool(single.max() > 0.7),
        ),
        Statement(
            "and still does so more than the least at the end",
            f"{single[late].mean():.1%} in the last 50 episodes",
            bool(single[late].mean() > 1.2 * LEAST),
        ),
        Statement(
            "double Q-learning is all but free of it",
            f"{double[late].mean():.1%}, and {double.max():.0%} at most",
            bool(double[late].mean() < single[late].mean() and double.max() < 0.6),
        ),
    ]


if __name__ == "__main__":
    main()

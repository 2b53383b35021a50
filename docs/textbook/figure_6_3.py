"""Figure 6.3: three TD control methods on the cliff, by step size (section 6.6).

    python docs/textbook/figure_6_3.py              # 100 runs: three minutes; the book has 50,000

The plot has the mean return of training episodes with a constant epsilon of 0.1: over the first 100
episodes (interim) and over 20,000 (asymptotic; the book has 100,000). The target of expected SARSA
has no variance from the next action, so its step size can be 1.
"""

from __future__ import annotations

import numpy as np
from _figures import Statement, agent_on, arguments, canvas, finish, learn_episodes

STEP_SIZES = np.arange(1, 11) / 10
INTERIM, ASYMPTOTIC = 100, 20_000
N_LONG_RUNS = 5
LABELS = {"sarsa": "SARSA", "expected_sarsa": "expected SARSA", "qlearning": "Q-learning"}
Curves = dict[str, tuple[list[float], list[float]]]  # by agent: interim, asymptotic


def mean_return(algo: str, step_size: float, n_episodes: int, n_runs: int) -> float:
    """Mean return of all episodes of all runs."""
    means = []
    for seed in range(n_runs):
        agent = agent_on("CliffWalking-v1", algo, seed, learning_rate=step_size)
        means.append(learn_episodes(agent, n_episodes)[0].mean())
    return float(np.mean(means))


def statements(curves: Curves) -> list[Statement]:
    """The book's statements on the curves."""
    expected_interim, expected_long = curves["expected_sarsa"]
    sarsa_interim, sarsa_long = curves["sarsa"]
    q_interim, q_long = curves["qlearning"]
    better = [
        e > max(s, q) for e, s, q in zip(expected_interim, sarsa_interim, q_interim, strict=True)
    ]
    return [
        Statement(
            "expected SARSA is ahead of both over a wide range of step sizes",
            f"interim at {sum(better)} of {len(better)} step sizes",
            sum(better) >= len(better) - 2,
        ),
        Statement(
            "it may set its step size to 1 without any loss at the end",
            f"asymptotic {min(expected_long):.1f} to {max(expected_long):.1f}",
            max(expected_long) - min(expected_long) < 2,
        ),
        Statement(
            "SARSA does well in the long run only at a small step size",
            f"{sarsa_long[0]:.1f} at 0.1, {sarsa_long[-1]:.1f} at 1",
            sarsa_long[0] - sarsa_long[-1] > 20,
        ),
        Statement(
            "Q-learning earns less than both while it explores",
            f"{max(q_long):.1f} at best, expected SARSA {max(expected_long):.1f}",
            max(q_long) < max(expected_long) and max(q_long) < sarsa_long[0],
        ),
    ]


def main() -> None:
    """Draw the figure, and compare it with the book."""
    args = arguments("Figure 6.3 of Sutton and Barto: three targets on the cliff.", 100)
    figure, axes = canvas("CliffWalking-v1", "step size", "mean return of an episode")
    curves: Curves = {}
    for algo, label in LABELS.items():
        interim = [mean_return(algo, size, INTERIM, args.runs) for size in STEP_SIZES]
        asymptotic = [mean_return(algo, size, ASYMPTOTIC, N_LONG_RUNS) for size in STEP_SIZES]
        curves[algo] = interim, asymptotic
        (line,) = axes.plot(STEP_SIZES, asymptotic, marker="o", label=f"{label}, asymptotic")
        style = {"linestyle": "--", "marker": "x", "color": line.get_color()}
        axes.plot(STEP_SIZES, interim, label=f"{label}, interim", **style)
    axes.set_ylim(-160, 0)
    axes.legend(fontsize="small")
    finish("figure_6_3", figure, args.folder, statements(curves))


if __name__ == "__main__":
    main()

"""The figure in example 6.2, right: TD(0) and Monte Carlo on the walk of five states.

    python docs/textbook/figure_6_2.py              # 100 runs, as in the book: half a minute

The plot has the error of predicted values after each of 100 episodes. All values begin at 0.5.
"""

from __future__ import annotations

import numpy as np
from _figures import Statement, arguments, canvas, errors_of_runs, finish

N_EPISODES = 100
STEP_SIZES = {"qlearning": (0.15, 0.1, 0.05), "monte_carlo": (0.01, 0.02, 0.03, 0.04)}
LABELS = {"qlearning": "TD", "monte_carlo": "Monte Carlo"}


def main() -> None:
    """Draw the figure, and compare it with the book."""
    args = arguments("Example 6.2 of Sutton and Barto, right: TD(0) and Monte Carlo.", 100)
    figure, axes = canvas("RandomWalk-v0, 5 states", "episodes", "root mean square error")
    ends, sums = {}, {}
    for algo, step_sizes in STEP_SIZES.items():
        for size in step_sizes:
            errors = errors_of_runs(
                algo, range(args.runs), N_EPISODES, {}, learning_rate=size, initial_q=0.5
            ).mean(axis=0)
            ends[algo, size], sums[algo, size] = errors[-1], errors.mean()
            style = "-" if algo == "qlearning" else "--"
            axes.plot(np.arange(1, N_EPISODES + 1), errors, style, label=f"{LABELS[algo]} {size:g}")
    axes.set_ylim(0, 0.25)
    axes.legend(fontsize="small", ncols=2)
    finish("figure_6_2", figure, args.folder, statements(ends, sums))


def statements(
    ends: dict[tuple[str, float], float], sums: dict[tuple[str, float], float]
) -> list[Statement]:
    """The book's statements on the errors at the end, and on mean errors over all episodes."""
    by_algo = {algo: [sums[algo, size] for size in sizes] for algo, sizes in STEP_SIZES.items()}
    worst, best = max(by_algo["qlearning"]), min(by_algo["monte_carlo"])
    return [
        Statement(
            "TD is consistently better than Monte Carlo",
            f"over all episodes {worst:.3f} at its worst, Monte Carlo {best:.3f} at its best",
            worst < best,
        ),
        Statement(
            "a large step size is fast at first, and ends with the larger error",
            f"TD ends at {ends['qlearning', 0.15]:.3f} with 0.15, at "
            f"{ends['qlearning', 0.05]:.3f} with 0.05",
            ends["qlearning", 0.15] > ends["qlearning", 0.05],
        ),
    ]


if __name__ == "__main__":
    main()

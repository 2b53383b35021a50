"""Figure 7.2: n-step TD on the walk of 19 states (example 7.1).

    python docs/textbook/figure_7_2.py              # 100 runs, as in the book: three minutes

The error of the predicted values, over the first ten episodes. All values begin at 0.
"""

from __future__ import annotations

import numpy as np
from _figures import Statement, arguments, canvas, finish
from _random_walks import errors_of_runs

WALK = {"n_states": 19, "left_reward": -1}
N_EPISODES = 10
LENGTHS = tuple(2**k for k in range(10))
STEP_SIZES = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
TOP = 0.55  # of the picture


def errors(n: int, n_runs: int) -> list[float]:
    """For each step size, over the first episodes of all runs."""
    return [
        float(
            errors_of_runs(
                "n_step_sarsa", range(n_runs), N_EPISODES, WALK, learning_rate=size, n_steps=n
            ).mean()
        )
        for size in STEP_SIZES
    ]


def main() -> None:
    """Draw the figure, and hold it against the book."""
    args = arguments("Figure 7.2 of Sutton and Barto: n-step TD.", 100)
    figure, axes = canvas(
        "RandomWalk-v0, 19 states", "step size", "error over the first 10 episodes"
    )
    best = {}
    for n in LENGTHS:
        curve = errors(n, args.runs)
        best[n] = min(curve)
        axes.plot(STEP_SIZES, curve, label=f"n = {n}")
    axes.set_ylim(0.25, TOP)
    axes.legend(fontsize="small", ncols=2)
    finish("figure_7_2", figure, args.folder, statements(best))


def statements(best: dict[int, float]) -> list[Statement]:
    """What the book says, of the least error for each n."""
    first, last = LENGTHS[0], LENGTHS[-1]
    n = min(best, key=lambda length: best[length])
    return [
        Statement(
            "an intermediate n is best",
            f"n = {n}: {best[n]:.3f}; n = {first}: {best[first]:.3f}; n = {last}: {best[last]:.3f}",
            first < n < last and best[n] < 0.9 * min(best[first], best[last]),
        )
    ]


if __name__ == "__main__":
    main()

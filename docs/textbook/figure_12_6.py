"""Figure 12.6: TD(lambda) on the walk of 19 states (section 12.2).

    python docs/textbook/figure_12_6.py              # 100 runs: three minutes

The error of the predicted values, over the first ten episodes, with accumulating traces.
"""

from __future__ import annotations

import numpy as np
from _figures import Statement, arguments, canvas, finish
from _random_walks import errors_of_runs

WALK = {"n_states": 19, "left_reward": -1}
N_EPISODES = 10
DECAYS = (0.0, 0.4, 0.8, 0.9, 0.95, 0.975, 0.99, 1.0)
STEP_SIZES = np.array([0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
LARGEST = 2.0  # of an error that means something
TOP = 0.55  # of the picture


def errors(decay: float, n_runs: int) -> list[float]:
    """For each step size, over the first episodes of all runs."""
    found = []
    for size in STEP_SIZES:
        with np.errstate(over="ignore", invalid="ignore"):  # large steps diverge
            runs = errors_of_runs(
                "sarsa_lambda",
                range(n_runs),
                N_EPISODES,
                WALK,
                learning_rate=size,
                trace_decay=decay,
                trace_type="accumulating",
            )
        mean = float(runs.mean())
        found.append(mean if mean < LARGEST else float("nan"))
    return found


def main() -> None:
    """Draw the figure, and hold it against the book."""
    args = arguments("Figure 12.6 of Sutton and Barto: TD(lambda).", 100)
    figure, axes = canvas(
        "RandomWalk-v0, 19 states", "step size", "error over the first 10 episodes"
    )
    curves = {decay: errors(decay, args.runs) for decay in DECAYS}
    for decay, curve in curves.items():
        axes.plot(STEP_SIZES, curve, label=f"lambda = {decay:g}")
    axes.set_ylim(0.25, TOP)
    axes.legend(fontsize="small", ncols=2)
    finish("figure_12_6", figure, args.folder, statements(curves))


def statements(curves: dict[float, list[float]]) -> list[Statement]:
    """What the book says of the curves."""
    best = {decay: float(np.nanmin(curve)) for decay, curve in curves.items()}
    decay = min(best, key=lambda each: best[each])
    diverges = [each for each, curve in curves.items() if np.isnan(curve[-1])]
    return [
        Statement(
            "an intermediate lambda is best",
            f"lambda = {decay:g}: {best[decay]:.3f}; 0: {best[0.0]:.3f}; 1: {best[1.0]:.3f}",
            0 < decay < 1 and best[decay] < 0.9 * min(best[0.0], best[1.0]),
        ),
        Statement(
            "where both are large, it is unstable",
            f"at step size 1 for lambda = {', '.join(f'{each:g}' for each in diverges)}",
            bool(diverges) and min(diverges) > DECAYS[1],
        ),
    ]


if __name__ == "__main__":
    main()

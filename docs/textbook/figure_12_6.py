"""Figure 12.6: TD(lambda) on the walk of 19 states (section 12.2).

    python docs/textbook/figure_12_6.py              # 100 runs: three minutes

The plot has the mean error of values over the first ten episodes, with accumulating traces.
"""

from __future__ import annotations

import numpy as np
from _figures import Statement, arguments, finish, step_size_curves

DECAYS = (0.0, 0.4, 0.8, 0.9, 0.95, 0.975, 0.99, 1.0)
STEP_SIZES = np.array([0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])


def main() -> None:
    """Draw the figure, and compare it with the book."""
    args = arguments("Figure 12.6 of Sutton and Barto: TD(lambda).", 100)
    settings = {each: {"trace_decay": each, "trace_type": "accumulating"} for each in DECAYS}
    figure, curves = step_size_curves("lambda", "sarsa_lambda", STEP_SIZES, settings, args.runs)
    finish("figure_12_6", figure, args.folder, statements(curves))


def statements(curves: dict[float, list[float]]) -> list[Statement]:
    """The book's statements on the curves."""
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

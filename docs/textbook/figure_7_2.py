"""Figure 7.2: n-step TD on the walk of 19 states (example 7.1).

    python docs/textbook/figure_7_2.py              # 100 runs, as in the book: three minutes

The plot has the mean error of predicted values over the first ten episodes. All values begin at 0.
"""

from __future__ import annotations

import numpy as np
from _figures import Statement, arguments, finish, step_size_curves

LENGTHS = tuple(2**k for k in range(10))
STEP_SIZES = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])


def main() -> None:
    """Draw the figure, and compare it with the book."""
    args = arguments("Figure 7.2 of Sutton and Barto: n-step TD.", 100)
    settings = {n: {"n_steps": n} for n in LENGTHS}
    figure, curves = step_size_curves("n", "n_step_sarsa", STEP_SIZES, settings, args.runs)
    best = {n: float(np.nanmin(curve)) for n, curve in curves.items()}
    finish("figure_7_2", figure, args.folder, statements(best))


def statements(best: dict[int, float]) -> list[Statement]:
    """The book's statement on the smallest error for each n."""
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

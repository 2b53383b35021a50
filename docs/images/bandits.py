"""Draws the pictures of docs/bandits.md: ``python docs/images/bandits.py``, half a minute."""

from __future__ import annotations

import tempfile
from pathlib import Path

import gymnasium as gym
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

import rl_yardstick.envs  # noqa: F401  # registers the bandits
from rl_yardstick.agents.bandits.runs import run_batch
from rl_yardstick.envs.bandits import log_uniformly, read_log
from rl_yardstick.experiments.off_policy import cross_fit, evaluate_policy, mean_reward
from rl_yardstick.report.series import COLOURS

FOLDER = Path(__file__).parent
PULLS, RUNS = 10_000, 400
TESTED = 3_000
SHARES = np.array([0.3, 0.7])
RATES = np.array([[0.10, 0.25, 0.05], [0.12, 0.06, 0.05]])
ALIKE = np.array([[0.12, 0.06, 0.05], [0.12, 0.06, 0.05]])

AGENTS = {
    "Thompson, blind": ("thompson", {"ignore_context": True}),
    "Thompson for each segment": ("thompson", {}),
    "LinUCB": ("linucb", {}),
}

Floats = NDArray[np.float64]


def main() -> None:
    """Write both pictures."""
    mpl.use("Agg")
    draw_regret()
    draw_estimates()


def draw_regret() -> None:
    """What is lost to the best policy by segment, where segments differ and where they do not."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, rates, title in zip(
        axes, (RATES, ALIKE), ("segments differ", "segments do not differ"), strict=True
    ):
        curves = {
            f"A/B test of {TESTED:,}, then one for all": after_test(rates, by_segment=False),
            f"A/B test of {TESTED:,}, read by segment": after_test(rates, by_segment=True),
        }
        env_kwargs = {"click_rates": rates.tolist(), "pulls": PULLS}
        for name, (algo, kwargs) in AGENTS.items():
            result = run_batch(algo, kwargs, "SegmentBandit-v0", env_kwargs, range(RUNS))
            curves[name] = result.regrets.cumsum(axis=1)
        for colour, (name, regret) in zip(COLOURS, curves.items(), strict=False):
            low, high = np.quantile(regret, [0.05, 0.95], axis=0)
            axis.plot(regret.mean(axis=0), color=colour, label=name)
            axis.fill_between(np.arange(PULLS), low, high, color=colour, alpha=0.15, linewidth=0)
        axis.set(xlabel="users", title=title, xlim=(0, PULLS), ylim=(0, None))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("clicks lost")
    axes[0].legend(fontsize=9, loc="upper left")
    figure.savefig(FOLDER / "bandit-segments.png", dpi=90)


def after_test(rates: Floats, by_segment: bool) -> Floats:
    """Cumulative regrets of a uniform test and of its winner from then on, shape (RUNS, PULLS)."""
    rng = np.random.default_rng(0)
    segments = rng.choice(2, size=(RUNS, PULLS), p=SHARES)
    arms = rng.integers(3, size=(RUNS, PULLS))
    clicks = rng.random((RUNS, PULLS)) < rates[segments, arms]
    for run in range(RUNS):
        rows = np.zeros(PULLS, np.int64) if not by_segment else segments[run]
        cells = rows[:TESTED] * 3 + arms[run, :TESTED]
        sums = np.bincount(cells, clicks[run, :TESTED], minlength=6)
        winner = (
            (sums / np.maximum(np.bincount(cells, minlength=6), 1)).reshape(2, 3).argmax(axis=1)
        )
        arms[run, TESTED:] = winner[rows[TESTED:]]
    return np.cumsum(rates.max(axis=1)[segments] - rates[segments, arms], axis=1)


def draw_estimates() -> None:
    """Policies judged on one uniform log, beside what they are worth."""
    with tempfile.TemporaryDirectory() as folder, gym.make("SegmentBandit-v0") as env:
        log_uniformly(env, 5_000, 1, Path(folder) / "log.csv")
        data = read_log(Path(folder) / "log.csv")
    contexts = data.observations(data.observation_space)
    predicted = cross_fit(contexts, data.arms, data.rewards, 3)
    tables = {f"always treatment {arm}": np.eye(3)[[arm, arm]] for arm in range(3)}
    tables["best for each segment"] = np.eye(3)[RATES.argmax(axis=1)]
    figure, axis = plt.subplots(figsize=(7.5, 3.6), layout="constrained")
    names = {"ips": "IPS", "snips": "self-normalised", "doubly_robust": "doubly robust"}
    assert data.propensities is not None
    for row, table in enumerate(tables.values()):
        truth = float(SHARES @ (table * RATES).sum(axis=1))
        axis.plot([truth, truth], [row - 0.35, row + 0.35], color="0.3", linewidth=1.2)
        pulls = data.arms, data.rewards, data.propensities
        terms = evaluate_policy(table[contexts], *pulls, predicted)
        for place, (name, label) in enumerate(names.items()):
            estimate = mean_reward(getattr(terms, name))
            axis.errorbar(
                estimate.point,
                row + 0.2 * (place - 1),
                xerr=estimate.point - estimate.low,
                fmt="o",
                markersize=4,
                color=COLOURS[place],
                label=label if row == 0 else None,
            )
    axis.set_yticks(range(len(tables)), list(tables))
    axis.invert_yaxis()
    axis.set(xlabel="clicks a user (grey: the truth)", xlim=(0, None))
    axis.grid(axis="x", alpha=0.3)
    axis.legend(fontsize=9, loc="upper left", bbox_to_anchor=(1, 1))
    figure.savefig(FOLDER / "bandit-off-policy.png", dpi=90)


if __name__ == "__main__":
    main()

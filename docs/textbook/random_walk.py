"""Predictions on random walks: figure 6.2 (of example 6.2, right), 7.2 and 12.6.

    python docs/textbook/random_walk.py              # 100 runs, as in the book: seven minutes
    python docs/textbook/random_walk.py 7.2

6.2 has the error of predicted values after each of 100 episodes on the walk of five states, for TD
and Monte Carlo. All values begin at 0.5. 7.2 has the mean error over the first ten episodes on the
walk of 19 states (example 7.1), for n-step TD; 12.6 the same for TD(lambda) with accumulating
traces (section 12.2). All values begin at 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from _figures import MOST_STEPS, Statement, agent_on, canvas, main
from matplotlib.figure import Figure
from stable_baselines3.common.callbacks import CallbackList, StopTrainingOnMaxEpisodes

from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon
from rl_yardstick.mdp.transition_model import Floats

WALK = "envs:RandomWalk-v0"
LARGEST_ERROR = 2.0  # larger errors mean that learning diverges
N_EPISODES = 100
STEP_SIZES = {"qlearning": (0.15, 0.1, 0.05), "monte_carlo": (0.01, 0.02, 0.03, 0.04)}
LABELS = {"qlearning": "TD", "monte_carlo": "Monte Carlo"}
LENGTHS = tuple(2**k for k in range(10))
DECAYS = (0.0, 0.4, 0.8, 0.9, 0.95, 0.975, 0.99, 1.0)
LARGER = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


class ValueErrors(BlockCallback):
    """Root mean square errors of the predicted values of nonterminal states after each episode."""

    def __init__(self, true_values: Floats) -> None:
        super().__init__()
        self.true_values = true_values[1:-1]
        self.errors: list[float] = []
        self._has_ended = False

    def horizon(self) -> Horizon:
        return Horizon(episodes=1)

    def _on_step(self) -> bool:
        self._has_ended = bool(self.locals["dones"].any())
        return True

    def _on_rollout_end(self) -> None:  # by now, the agent has learnt from the last step
        if self._has_ended:
            policy: Any = self.model.policy
            differences = policy.q_table[1:-1, 0] - self.true_values
            self.errors.append(float(np.sqrt(np.mean(differences**2))))


def true_values(env_kwargs: dict[str, Any]) -> Floats:
    """The values of the states, from their probability of ending right, shape (n_states + 2,)."""
    walk: Any = gym.make(WALK, **env_kwargs).unwrapped
    right = np.arange(walk.n_states + 2) / (walk.n_states + 1)
    return np.asarray(walk.left_reward + (walk.right_reward - walk.left_reward) * right)


def errors_of_runs(
    algo: str, seeds: Sequence[int], n_episodes: int, env_kwargs: dict[str, Any], **settings: Any
) -> Floats:
    """Root mean square errors over the states after each episode, shape (n_runs, n_episodes).

    There is only one action, so its value is the state's value.
    """
    values = true_values(env_kwargs)
    agent = agent_on(WALK, algo, 0, env_kwargs=env_kwargs, **settings)
    start = {name: table.clone() for name, table in agent.policy.state_dict().items()}
    runs = []
    for seed in seeds:
        # Resetting the agent takes a tenth of the time of making a new one.
        agent.policy.load_state_dict(start)
        agent.set_random_seed(seed)
        errors = ValueErrors(values)
        stop = StopTrainingOnMaxEpisodes(n_episodes)
        agent.learn(MOST_STEPS, callback=CallbackList([errors, stop]), log_interval=None)
        runs.append(errors.errors[:n_episodes])
    return np.array(runs)


def step_size_curves(
    name: str, algo: str, step_sizes: Floats, settings: dict[Any, dict[str, Any]], n_runs: int
) -> tuple[Figure, dict[Any, list[float]]]:
    """Plot errors over the first ten episodes on the walk of 19 states by step size and setting.

    Errors above `LARGEST_ERROR` are NaN.
    """
    figure, axes = canvas(
        "RandomWalk-v0, 19 states", "step size", "error over the first 10 episodes"
    )
    walk, curves = {"n_states": 19, "left_reward": -1}, {}
    for each, own in settings.items():
        curve = []
        for size in step_sizes:
            with np.errstate(over="ignore", invalid="ignore"):
                runs = errors_of_runs(algo, range(n_runs), 10, walk, learning_rate=size, **own)
            mean = float(runs.mean())
            curve.append(mean if mean < LARGEST_ERROR else float("nan"))
        axes.plot(step_sizes, curve, label=f"{name} = {each:g}")
        curves[each] = curve
    axes.set_ylim(0.25, 0.55)
    axes.legend(fontsize="small", ncols=2)
    return figure, curves


def td_and_monte_carlo(n_runs: int) -> tuple[Figure, list[Statement]]:
    """Figure 6.2."""
    figure, axes = canvas("RandomWalk-v0, 5 states", "episodes", "root mean square error")
    ends, sums = {}, {}
    for algo, step_sizes in STEP_SIZES.items():
        for size in step_sizes:
            errors = errors_of_runs(
                algo, range(n_runs), N_EPISODES, {}, learning_rate=size, initial_q=0.5
            ).mean(axis=0)
            ends[algo, size], sums[algo, size] = errors[-1], errors.mean()
            style = "-" if algo == "qlearning" else "--"
            axes.plot(np.arange(1, N_EPISODES + 1), errors, style, label=f"{LABELS[algo]} {size:g}")
    axes.set_ylim(0, 0.25)
    axes.legend(fontsize="small", ncols=2)
    worst = max(sums["qlearning", size] for size in STEP_SIZES["qlearning"])
    best = min(sums["monte_carlo", size] for size in STEP_SIZES["monte_carlo"])
    large, small = ends["qlearning", 0.15], ends["qlearning", 0.05]
    return figure, [
        Statement(
            "TD is consistently better than Monte Carlo",
            f"over all episodes {worst:.3f} at its worst, Monte Carlo {best:.3f} at its best",
            worst < best,
        ),
        Statement(
            "a large step size is fast at first, and ends with the larger error",
            f"TD ends at {large:.3f} with 0.15, at {small:.3f} with 0.05",
            large > small,
        ),
    ]


def n_step_td(n_runs: int) -> tuple[Figure, list[Statement]]:
    """Figure 7.2."""
    settings = {n: {"n_steps": n} for n in LENGTHS}
    sizes = np.array([0.02, *LARGER])
    figure, curves = step_size_curves("n", "n_step_sarsa", sizes, settings, n_runs)
    best = {n: float(np.nanmin(curve)) for n, curve in curves.items()}
    n, first, last = min(best, key=best.__getitem__), LENGTHS[0], LENGTHS[-1]
    return figure, [
        Statement(
            "an intermediate n is best",
            f"n = {n}: {best[n]:.3f}; n = {first}: {best[first]:.3f}; n = {last}: {best[last]:.3f}",
            first < n < last and best[n] < 0.9 * min(best[first], best[last]),
        )
    ]


def td_lambda(n_runs: int) -> tuple[Figure, list[Statement]]:
    """Figure 12.6."""
    settings = {each: {"trace_decay": each, "trace_type": "accumulating"} for each in DECAYS}
    sizes = np.array([0.01, 0.02, *LARGER])
    figure, curves = step_size_curves("lambda", "sarsa_lambda", sizes, settings, n_runs)
    best = {decay: float(np.nanmin(curve)) for decay, curve in curves.items()}
    decay = min(best, key=best.__getitem__)
    diverges = [each for each, curve in curves.items() if np.isnan(curve[-1])]
    return figure, [
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
    figures = {"6.2": td_and_monte_carlo, "7.2": n_step_td, "12.6": td_lambda}
    main(__doc__, {number: (draw, 100) for number, draw in figures.items()})

"""Figure 10.1: the cost-to-go function of the mountain car during learning (example 10.1).

    python docs/textbook/figure_10_1.py              # 9,000 episodes, as in the book: a minute

The cost-to-go is the negative of the largest action value: the estimated number of steps to the
goal. The agent is semi-gradient SARSA on eight tilings, with optimistic values of 0, and epsilon 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from _figures import Statement, arguments, finish, learn_episodes
from matplotlib.figure import Figure
from stable_baselines3.common.env_util import make_vec_env

from rl_yardstick.agents.linear.action_values import SemiGradientSARSA
from rl_yardstick.mdp.transition_model import Floats

MOMENTS = (12, 104, 1000, 9000)  # episodes
LONGEST = 100_000  # steps; the book's episodes have no limit
POSITIONS, VELOCITIES = np.linspace(-1.2, 0.5, 60), np.linspace(-0.07, 0.07, 60)


def learner() -> SemiGradientSARSA:
    """The agent of example 10.1."""
    env = make_vec_env("MountainCar-v0", seed=0, env_kwargs={"max_episode_steps": LONGEST})
    return SemiGradientSARSA(
        "TilePolicy",
        env,
        learning_rate=0.5,
        n_tilings=8,
        n_tiles=8,
        gamma=1.0,
        exploration_decay="constant",
        exploration_initial_eps=0.0,
        seed=0,
    )


def cost_to_go(agent: Any) -> Floats:
    """The cost-to-go over positions and velocities, shape (60, 60)."""
    grid = np.stack(np.meshgrid(POSITIONS, VELOCITIES, indexing="ij"), axis=-1)
    sums = agent.policy.sums(grid.reshape(-1, 2).astype(np.float32))
    costs: Floats = -sums.max(axis=1).reshape(grid.shape[:2])
    return costs


def main() -> None:
    """Draw the figure, and compare it with the book."""
    args = arguments("Figure 10.1 of Sutton and Barto: the mountain car.", MOMENTS[-1])
    agent, figure = learner(), Figure(figsize=(9, 7.4), layout="constrained")
    costs, lengths = {}, np.empty(0)
    for axes, moment in zip(figure.subplots(2, 2).ravel(), MOMENTS, strict=True):
        _, more = learn_episodes(agent, min(moment, args.runs) - len(lengths))
        lengths = np.concatenate([lengths, more])
        costs[moment] = cost_to_go(agent)
        mesh = axes.pcolormesh(POSITIONS, VELOCITIES, costs[moment].T, cmap="viridis")
        axes.set(title=f"after {moment:,} episodes", xlabel="position", ylabel="velocity")
        figure.colorbar(mesh, ax=axes, shrink=0.8, label="cost-to-go")
    finish("figure_10_1", figure, args.folder, statements(lengths, costs))


def statements(lengths: Floats, costs: dict[int, Floats]) -> list[Statement]:
    """The book's statements on lengths of episodes, and on costs-to-go by number of episodes."""
    last = costs[MOMENTS[-1]]
    start = int(np.abs(POSITIONS + 0.5).argmin()), int(np.abs(VELOCITIES).argmin())
    return [
        Statement(
            "the first episode takes long, as everything unseen looks better",
            f"{lengths[0]:.0f} steps; the last hundred take {lengths[-100:].mean():.0f}",
            bool(lengths[0] > 400 and lengths[-100:].mean() < 160),
        ),
        Statement(
            "in the end the costs reach 120",
            f"{last.max():.0f} at most, {last[start]:.0f} at rest in the valley",
            bool(90 < last.max() < 150),
        ),
        Statement(
            "near the goal, and fast, there is little left",
            f"{last[-1, -1]:.1f}",
            bool(last[-1, -1] < 0.2 * last.max()),
        ),
    ]


if __name__ == "__main__":
    main()

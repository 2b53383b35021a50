"""Control: the cliff (figure 6.3), maximization bias (6.5) and the mountain car (10.1).

    python docs/textbook/control.py              # six minutes
    python docs/textbook/control.py 10.1 --folder figures

6.3 (section 6.6) has the mean return of training episodes on the cliff by step size, with a
constant epsilon of 0.1: over the first 100 episodes (interim) and over 20,000 (asymptotic; the book
has 100,000), of 100 runs (the book has 50,000). The target of expected SARSA has no variance from
the next action, so its step size can be 1.

6.5 (section 6.7) has the share of 1,000 runs (the book has 10,000) that go left from A in each of
the first 300 episodes. An epsilon-greedy agent goes left in at least 5 % of the cases.

10.1 (example 10.1) has the cost-to-go of the mountain car, in 9,000 episodes as in the book: the
negative of the largest action value, or the estimated number of steps to the goal. The agent is
semi-gradient SARSA on eight tilings, with optimistic values of 0, and epsilon 0.
"""

from __future__ import annotations

import numpy as np
from _figures import Statement, agent_on, canvas, learn_episodes, main
from matplotlib.figure import Figure

STEP_SIZES = np.arange(1, 11) / 10
INTERIM, ASYMPTOTIC = 100, 20_000
N_LONG_RUNS = 5
ON_CLIFF = {"sarsa": "SARSA", "expected_sarsa": "expected SARSA", "qlearning": "Q-learning"}
N_EPISODES = 300
BIAS = "envs:MaximizationBias-v0"
LEFT = 2  # steps of an episode that goes left
LEAST = 0.05  # half of epsilon, for two actions
BIASED = {"qlearning": "Q-learning", "double_qlearning": "double Q-learning"}
MOMENTS = (12, 104, 1000, 9000)  # episodes
LONGEST = 100_000  # steps; the book's episodes have no limit
POSITIONS, VELOCITIES = np.linspace(-1.2, 0.5, 60), np.linspace(-0.07, 0.07, 60)


def mean_return(algo: str, step_size: float, n_episodes: int, n_runs: int) -> float:
    """Mean return of all episodes of all runs."""
    means = []
    for seed in range(n_runs):
        agent = agent_on("CliffWalking-v1", algo, seed, learning_rate=step_size)
        means.append(learn_episodes(agent, n_episodes)[0].mean())
    return float(np.mean(means))


def on_the_cliff(n_runs: int) -> tuple[Figure, list[Statement]]:
    """Figure 6.3."""
    figure, axes = canvas("CliffWalking-v1", "step size", "mean return of an episode")
    curves = {}
    for algo, label in ON_CLIFF.items():
        interim = [mean_return(algo, size, INTERIM, n_runs) for size in STEP_SIZES]
        asymptotic = [mean_return(algo, size, ASYMPTOTIC, N_LONG_RUNS) for size in STEP_SIZES]
        curves[algo] = interim, asymptotic
        (line,) = axes.plot(STEP_SIZES, asymptotic, marker="o", label=f"{label}, asymptotic")
        style = {"linestyle": "--", "marker": "x", "color": line.get_color()}
        axes.plot(STEP_SIZES, interim, label=f"{label}, interim", **style)
    axes.set_ylim(-160, 0)
    axes.legend(fontsize="small")
    expected_interim, expected_long = curves["expected_sarsa"]
    sarsa_interim, sarsa_long = curves["sarsa"]
    q_interim, q_long = curves["qlearning"]
    better = [
        e > max(s, q) for e, s, q in zip(expected_interim, sarsa_interim, q_interim, strict=True)
    ]
    return figure, [
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


def maximization_bias(n_runs: int) -> tuple[Figure, list[Statement]]:
    """Figure 6.5."""
    figure, axes = canvas("Maximization bias", "episodes", "left from A, % of runs")
    shares = []
    for algo, label in BIASED.items():
        lengths = []
        for seed in range(n_runs):
            agent = agent_on(BIAS, algo, seed, learning_rate=0.1, mask_actions=True)
            lengths.append(learn_episodes(agent, N_EPISODES)[1])
        shares.append((np.array(lengths) == LEFT).mean(axis=0))
        axes.plot(np.arange(1, N_EPISODES + 1), 100 * shares[-1], label=label)
    axes.axhline(100 * LEAST, color="grey", linestyle="--", label="least, by epsilon")
    axes.set_ylim(0, 100)
    axes.legend()
    single, double = shares
    late = slice(N_EPISODES - 50, None)
    return figure, [
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


def mountain_car(n_episodes: int) -> tuple[Figure, list[Statement]]:
    """Figure 10.1."""
    limit, tiles = {"max_episode_steps": LONGEST}, {"n_tilings": 8, "n_tiles": 8}
    greedy = {"learning_rate": 0.5, "exploration_initial_eps": 0.0}
    agent = agent_on(
        "MountainCar-v0", "semi_gradient_sarsa", 0, env_kwargs=limit, **tiles, **greedy
    )
    figure = Figure(figsize=(9, 7.4), layout="constrained")
    grid = np.stack(np.meshgrid(POSITIONS, VELOCITIES, indexing="ij"), axis=-1)
    lengths, last = np.empty(0), np.empty(0)
    for axes, moment in zip(figure.subplots(2, 2).ravel(), MOMENTS, strict=True):
        _, more = learn_episodes(agent, min(moment, n_episodes) - len(lengths))
        lengths = np.concatenate([lengths, more])
        sums = agent.policy.sums(grid.reshape(-1, 2).astype(np.float32))
        last = -sums.max(axis=1).reshape(grid.shape[:2])
        mesh = axes.pcolormesh(POSITIONS, VELOCITIES, last.T, cmap="viridis")
        axes.set(title=f"after {moment:,} episodes", xlabel="position", ylabel="velocity")
        figure.colorbar(mesh, ax=axes, shrink=0.8, label="cost-to-go")
    start = int(np.abs(POSITIONS + 0.5).argmin()), int(np.abs(VELOCITIES).argmin())
    return figure, [
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
    figures = {"6.3": (on_the_cliff, 100), "6.5": (maximization_bias, 1000)}
    main(__doc__, {**figures, "10.1": (mountain_car, MOMENTS[-1])})

"""Tells what the loss and the target do to a course unit's DQN on CartPole, in a plain program.

    python benchmarks/coursework_dqn.py            # four variants, seeds 0 to 5: about ten minutes
    python benchmarks/coursework_dqn.py --seeds 2

The unit trains after each episode, on 32 remembered transitions one by one. The study
``studies/cartpole-dqn.yml`` does the same through the library; this program owes it nothing, so
that the two can be held against each other. Figures are steps of the last 100 of 1000 episodes of
at most 200 steps; the last step of each is rewarded with -10 and nothing is expected after it.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import statistics
from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from torch import nn
from torch.nn.functional import mse_loss, smooth_l1_loss

N_EPISODES, MAX_STEPS, LAST = 1000, 200, 100
MEMORY, BATCH = 2000, 32
DISCOUNT, LEARNING_RATE = 0.95, 0.001
LEAST_EPSILON, EPSILON_FACTOR = 0.01, 0.995
FAILURE = -10.0

# Observation, action, reward, next observation, and whether the episode ended there.
Transition = tuple[Any, int, float, Any, bool]

LOSSES: dict[str, Callable[..., th.Tensor]] = {"squared": mse_loss, "Huber": smooth_l1_loss}


def best_value(network: nn.Module, observation: Any) -> th.Tensor:
    """The highest of the action values, a scalar."""
    return network(th.as_tensor(observation)).max()  # type: ignore[no-any-return]


def play(
    env: gym.Env[Any, Any], network: nn.Module, epsilon: float, rng: np.random.Generator
) -> list[Transition]:
    """Play an episode epsilon-greedily."""
    episode: list[Transition] = []
    observation, _ = env.reset()
    done = False
    while not done:
        explores = rng.random() < epsilon
        best = int(network(th.as_tensor(observation)).argmax())
        action = int(rng.integers(2)) if explores else best
        following, reward, terminated, truncated, _ = env.step(action)
        done = terminated or truncated
        episode.append((observation, action, FAILURE if done else float(reward), following, done))
        observation = following
    return episode


def learn(
    network: nn.Module,
    optimizer: th.optim.Optimizer,
    batch: list[Transition],
    loss_name: str,
    target_moves: bool,
) -> None:
    """Learn from transitions one by one."""
    target_network = network if target_moves else copy.deepcopy(network)
    for observation, action, reward, following, done in batch:
        with th.no_grad():
            future = 0.0 if done else DISCOUNT * best_value(target_network, following)
            target = th.as_tensor(reward + future, dtype=th.float32)
        loss = LOSSES[loss_name](network(th.as_tensor(observation))[action], target)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()


def steps_of_last_episodes(seed: int, loss_name: str, target_moves: bool) -> float:
    """Train once.

    Args:
        seed: of network, exploration, memory and environment.
        loss_name: one of ``LOSSES``.
        target_moves: whether each update's target is the network as the update before has left it,
            or as it was before the episode's updates.

    Returns:
        Mean steps of the last episodes.
    """
    th.manual_seed(seed)
    rng = np.random.default_rng(seed)
    env = gym.make("CartPole-v1", max_episode_steps=MAX_STEPS)
    env.reset(seed=seed)
    hidden = [nn.Linear(4, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU()]
    network = nn.Sequential(*hidden, nn.Linear(32, 2))
    optimizer = th.optim.Adam(network.parameters(), lr=LEARNING_RATE)
    memory: deque[Transition] = deque(maxlen=MEMORY)
    epsilon, lengths = 1.0, []
    for _ in range(N_EPISODES):
        episode = play(env, network, epsilon, rng)
        memory.extend(episode)
        lengths.append(len(episode))
        if len(memory) >= BATCH:
            batch = [memory[i] for i in rng.choice(len(memory), BATCH, replace=False)]
            learn(network, optimizer, batch, loss_name, target_moves)
            epsilon = max(epsilon * EPSILON_FACTOR, LEAST_EPSILON)
    return statistics.mean(lengths[-LAST:])


def main() -> None:
    """Train every variant on every seed, and print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=6, help="seeds 0 to N-1 (default: 6)")
    n_seeds = parser.parse_args().seeds
    th.set_num_threads(1)
    for loss_name, target_moves in itertools.product(LOSSES, (True, False)):
        results = [steps_of_last_episodes(seed, loss_name, target_moves) for seed in range(n_seeds)]
        target = "moves with each update" if target_moves else "stands still for the 32"
        spread = statistics.stdev(results) if n_seeds > 1 else 0.0
        each = " ".join(f"{result:.0f}" for result in results)
        print(
            f"{loss_name:8} loss, target {target:24} {statistics.mean(results):6.1f} ± {spread:.1f}"
            f"  (seeds 0 to {n_seeds - 1}: {each})",
            flush=True,
        )


if __name__ == "__main__":
    main()

"""Rollouts of environments in Python, with compiled acting, in the library's order of events."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from agents.networks.matrix_products import Singles
from agents.networks.policy_learner import act_on_rows, evaluate_rows
from agents.networks.policy_training import PolicyTraining
from agents.networks.rollouts import estimate_advantages
from mdp.array_types import Bools


def collect_rollout(training: PolicyTraining, env: VecEnv, callback: BaseCallback) -> bool:
    """Fill the rollout buffer, once callbacks have been told that it begins.

    Returns:
        False once a callback asks to stop.
    """
    agent, held, buffer = training.agent, training.held, training.agent.rollout_buffer
    agent.collected = 0
    training.read()
    buffer.pos, buffer.full = 0, False
    for step in range(agent.n_steps):
        actions = _act(training, step)
        new_obs, rewards, dones, infos = env.step(actions.copy())
        agent.num_timesteps += env.num_envs
        told = {"new_obs": new_obs, "rewards": rewards, "dones": dones, "infos": infos}
        callback.update_locals({**_said(training, env, step), "actions": actions, **told})
        if not callback.on_step():
            return False
        agent._update_info_buffer(infos, dones)
        held.rollout.rewards[step] = rewards + _cut_off(training, dones, infos)
        agent._last_obs, agent._last_episode_starts, held.starts[:] = new_obs, dones, dones
        buffer.pos = step + 1
    buffer.full = True
    training.show(agent._last_obs)
    evaluate_rows(training.learner, training.shown, held.last_values)
    estimate_advantages(training.learner, 0.0, 0.0)
    callback.on_rollout_end()
    return True


def _act(training: PolicyTraining, step: int) -> Any:
    """Actions for the present observations, written down with what belongs to them."""
    actions = np.zeros(training.agent.n_envs, np.int64)
    training.place["step"] = step
    training.read_generator()
    training.tensors.trained.take_over()
    training.show(training.agent._last_obs)
    act_on_rows(training.learner, training.shown, actions)
    training.memory.held.observations[step] = training.shown
    return actions


def _said(training: PolicyTraining, env: VecEnv, step: int) -> dict[str, Any]:
    """What callbacks read under the library's names of where the rollout is."""
    rollout = training.held.rollout
    return {
        "self": training.agent,
        "env": env,
        "rollout_buffer": training.agent.rollout_buffer,
        "n_rollout_steps": training.agent.n_steps,
        "n_steps": step,
        "values": th.tensor(rollout.values[step, :, np.newaxis]),
        "log_probs": th.tensor(rollout.log_probs[step]),
    }


def _cut_off(training: PolicyTraining, dones: Bools, infos: list[dict[str, Any]]) -> Singles:
    """What would have come after episodes that ran out of time, shape (E,)."""
    lost = np.zeros(len(dones), np.float32)
    values = np.zeros(1, np.float32)
    shown = training.shown[:1]
    for i in np.flatnonzero(dones):
        if infos[i].get("TimeLimit.truncated", False):
            shown[:] = np.reshape(infos[i]["terminal_observation"], (1, -1))
            training.check_numbers(shown)
            evaluate_rows(training.learner, shown, values)
            lost[i] = np.float32(training.agent.gamma) * values[0]
    return lost

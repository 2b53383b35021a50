"""Augmented random search: callbacks see each step once and can end it; it goes on where it was."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from torch.nn.utils import parameters_to_vector

from agents.common.callbacks import EpisodeBudget
from agents.random_search import ARS


class Watch(BaseCallback):
    """Keeps the number of steps done, and the episodes that ended, at each call."""

    def __init__(self):
        super().__init__()
        self.steps = []
        self.ended = []

    def _on_step(self):
        self.steps.append(self.num_timesteps)
        self.ended.append(int(np.sum(self.locals["dones"])))
        assert len(self.locals["infos"]) == len(self.locals["rewards"]) == len(self.locals["dones"])
        return True


def make(n_envs=1, **kwargs):
    env = make_vec_env("CartPole-v1", n_envs, seed=0)
    return ARS("LinearPolicy", env, seed=0, **{"n_delta": 2, **kwargs})


@pytest.mark.parametrize(("n_envs", "n_eval_episodes"), [(1, 1), (1, 2), (3, 1), (3, 4)])
def test_each_step_of_the_environments_is_counted_once(n_envs, n_eval_episodes):
    """With several environments, the library counts one for each whose episode is not over."""
    calls = []

    class Step(gym.Wrapper):
        def step(self, action):
            calls.append(1)
            return super().step(action)

    env = make_vec_env(lambda: Step(gym.make("CartPole-v1")), n_envs, seed=0)
    watch = Watch()
    model = ARS("LinearPolicy", env, n_delta=2, n_eval_episodes=n_eval_episodes, seed=0)
    model.learn(100, callback=watch)
    assert model.num_timesteps == len(calls)
    assert watch.steps == list(range(n_envs, model.num_timesteps + 1, n_envs))
    assert watch.n_calls == len(watch.steps)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_callback_ends_the_training(n_envs):
    class Ended(Watch):
        def _on_training_end(self):
            self.ended.append("end")

    watch = Ended()
    model = make(n_envs).learn(10**12, callback=[watch, EpisodeBudget(7)])
    assert watch.ended.pop() == "end"
    assert sum(watch.ended) >= 7 > sum(watch.ended[:-1])
    assert model.num_timesteps == watch.steps[-1]


@pytest.mark.parametrize("zero_policy", [True, False])
def test_what_was_loaded_goes_on_from_its_weights(zero_policy, tmp_path):
    """In the library the search begins at new random ones where zero_policy is off."""
    model = make(zero_policy=zero_policy).learn(300)
    learnt = parameters_to_vector(model.policy.parameters())
    assert learnt.abs().max() > 0
    assert th.equal(model.weights, learnt)
    model.save(tmp_path / "ars")
    env = make_vec_env("CartPole-v1", 1, seed=0)
    loaded = ARS.load(tmp_path / "ars", env=env, seed=1, learning_rate=0.0)
    assert th.equal(loaded.weights, learnt)
    loaded.learn(50, reset_num_timesteps=False)
    assert th.equal(parameters_to_vector(loaded.policy.parameters()), learnt)


def test_schedules_follow_a_budget_of_episodes():
    class Progress(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_start(self):
            left.append(self.model._current_progress_remaining)

    left = []
    make().learn(10**12, callback=[Progress(), EpisodeBudget(16)])
    # Four updates of four episodes each.
    assert left == pytest.approx([1, 0.75, 0.5, 0.25], abs=0.01)


def test_schedules_of_a_second_training_go_on():
    model = make().learn(100)
    done = model.num_timesteps
    model.learn(300, reset_num_timesteps=False)
    assert 0 < model._current_progress_remaining <= 1 - done / (done + 300)


def test_the_search_itself_is_the_librarys():
    import sb3_contrib

    ours = make().learn(200)
    env = make_vec_env("CartPole-v1", 1, seed=0)
    theirs = sb3_contrib.ARS("LinearPolicy", env, seed=0, n_delta=2).learn(200)
    assert ours.num_timesteps == theirs.num_timesteps
    assert th.equal(ours.weights, theirs.weights)

"""Ctrl-C at any moment leaves a training that can go on."""

import os
import signal
import threading
import time

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

from agents import load_algorithm
from agents.common.callback_horizons import BlockCallback, Horizon
from agents.compiled.interrupts import interrupts_held

N_ENVS = 2


def work_interrupted(times, seen):
    with interrupts_held() as waiting:
        seen.append(waiting())
        for _ in range(times):
            signal.raise_signal(signal.SIGINT)
        seen.append(waiting())
    seen.append("the end")


def test_the_first_interrupt_waits_and_the_second_does_not():
    seen = {times: [] for times in range(3)}
    work_interrupted(0, seen[0])
    for times in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            work_interrupted(times, seen[times])
    assert seen == {0: [False, False, "the end"], 1: [False, True], 2: [False]}
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_handler_of_ones_own_is_called_afterwards():
    order = []
    previous = signal.signal(signal.SIGINT, lambda *_: order.append("handled"))
    try:
        with interrupts_held():
            signal.raise_signal(signal.SIGINT)
            order.append("inside")
    finally:
        signal.signal(signal.SIGINT, previous)
    assert order == ["inside", "handled"]


def test_other_threads_hold_nothing():
    waiting = []

    def work():
        with interrupts_held() as held:
            waiting.append(held())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert waiting == [False]


def train_until_interrupted(model, seconds):
    """Train without end until an interrupt comes; whether it was one that ended the training."""
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT))
    try:
        timer.start()
        model.learn(10**9, reset_num_timesteps=False, log_interval=20)
    except KeyboardInterrupt:
        return True
    finally:
        timer.join()
    return False


class Stop(BlockCallback):
    """Ends the training on the 21st call: as an interrupt, or by what it returns."""

    def __init__(self, interrupts):
        super().__init__()
        self.interrupts = interrupts

    def horizon(self):
        return Horizon(calls=7)

    def _on_step(self):
        if self.n_calls == 21 and self.interrupts:
            signal.raise_signal(signal.SIGINT)
        return self.interrupts or self.n_calls < 21


def check(model, folder):
    """Counters, tables, Monitor and environments tell of the same steps."""
    steps = model.num_timesteps
    rows = [
        line.split(",")
        for i in range(N_ENVS)
        for line in (folder / f"{i}.monitor.csv").read_text().splitlines()[2:]
    ]
    under_way = sum(len(env.get_wrapper_attr("rewards")) for env in model.env.envs)
    assert sum(int(length) for _, length, _ in rows) + under_way == steps
    assert sum(env.get_wrapper_attr("total_steps") for env in model.env.envs) == steps
    assert int(model.policy.visit_counts.sum()) == model._n_updates == steps
    assert len(rows) == model._episode_num
    assert model._last_obs.tolist() == [env.unwrapped.s for env in model.env.envs]


def made(folder=None, n_envs=N_ENVS):
    folder = None if folder is None else str(folder)
    env = make_vec_env("FrozenLake-v1", n_envs, seed=0, monitor_dir=folder)
    return load_algorithm("sarsa")(env=env, seed=0, engine="compiled")


def test_interrupts_at_any_moment(tmp_path):
    # Twice, so that all is compiled before the first interrupt comes.
    model = made(tmp_path).learn(100).learn(50, reset_num_timesteps=False)
    rng = np.random.default_rng(0)
    for seconds in rng.uniform(0.0, 0.004, 40):
        before, started = model.num_timesteps, time.monotonic()
        assert train_until_interrupted(model, seconds)
        assert time.monotonic() - started < 5
        check(model, tmp_path)
        model.learn(50, reset_num_timesteps=False)
        check(model, tmp_path)
        assert model.num_timesteps >= before + 50
    assert model.num_timesteps > 10_000
    model.env.close()


@pytest.mark.parametrize("n_envs", [1, N_ENVS])
def test_an_interrupted_training_is_one_that_a_callback_stopped(n_envs):
    states = []
    for interrupts in (False, True):
        model = made(n_envs=n_envs)
        if interrupts:
            with pytest.raises(KeyboardInterrupt):
                model.learn(10_000, callback=Stop(interrupts))
        else:
            model.learn(10_000, callback=Stop(interrupts))
        assert model.num_timesteps == 21 * n_envs
        model.learn(400, reset_num_timesteps=False)
        states.append((model.policy.q_table.tobytes(), model.rng.bit_generator.state))
    assert states[0] == states[1]

"""Ctrl-C at any moment leaves a training that can go on."""

import signal
from contextlib import closing, contextmanager

import numpy as np
import pytest

from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon
from rl_yardstick.agents.compiled.engine import interrupts_held
from tests.agents.trainings import LAKE, environment, make

N_ENVS = 2


@contextmanager
def handling(number, handler):
    previous = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, previous)


def work_interrupted(number, times, seen):
    with interrupts_held() as waiting:
        seen.append(waiting())
        for _ in range(times):
            signal.raise_signal(number)
            seen.append(waiting())


def test_the_first_interrupt_waits_and_the_second_does_not():
    seen = {1: [], 2: []}
    for times, moments in seen.items():
        with pytest.raises(KeyboardInterrupt):
            work_interrupted(signal.SIGINT, times, moments)
    assert seen == {1: [False, True], 2: [False, True]}
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


class Interrupter(BlockCallback):
    """Lets an interrupt come so many seconds of the process's own work after that call."""

    def __init__(self, n_calls, seconds):
        super().__init__()
        self.after, self.seconds = n_calls, seconds

    def horizon(self):
        return Horizon(calls=max(self.after - self.n_calls, 1))

    def _on_step(self):
        if self.n_calls == self.after:
            signal.setitimer(signal.ITIMER_VIRTUAL, self.seconds)
        return True


def check(model, folder):
    """Counters, tables, Monitor and environments tell of the same steps."""
    steps = model.num_timesteps
    files = [folder / f"{i}.monitor.csv" for i in range(N_ENVS)]
    rows = [line.split(",") for path in files for line in path.read_text().splitlines()[2:]]
    under_way = sum(len(env.get_wrapper_attr("rewards")) for env in model.env.envs)
    assert sum(int(length) for _, length, _ in rows) + under_way == steps
    assert sum(env.get_wrapper_attr("total_steps") for env in model.env.envs) == steps
    assert int(model.policy.visit_counts.sum()) == model._n_updates == steps
    assert len(rows) == model._episode_num
    assert model._last_obs.tolist() == [env.unwrapped.s for env in model.env.envs]


@contextmanager
def made(folder=None):
    with closing(environment(LAKE, N_ENVS, folder=folder)) as env:
        yield make("sarsa", env, engine="compiled")


def test_interrupts_at_any_moment(tmp_path):
    rng = np.random.default_rng(0)
    moments = zip(rng.integers(1, 400, 8).tolist(), rng.uniform(0.0, 0.004, 8), strict=True)
    alarm = handling(signal.SIGVTALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    with made(tmp_path) as model, alarm:
        # Twice, so that all is compiled before the first interrupt comes.
        model.learn(100).learn(50, reset_num_timesteps=False)
        for n_calls, seconds in moments:
            before = model.num_timesteps
            with pytest.raises(KeyboardInterrupt):
                model.learn(10**9, Interrupter(n_calls, seconds), 20, reset_num_timesteps=False)
            # However busy the machine is, these many steps are done before it.
            assert model.num_timesteps >= before + n_calls * N_ENVS
            check(model, tmp_path)
            after = model.num_timesteps
            model.learn(50, reset_num_timesteps=False)
            check(model, tmp_path)
            assert model.num_timesteps == after + 50

"""Callbacks that name their steps, and logs that nobody reads."""

import numpy as np
import pytest
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import DISABLED, KVWriter, Logger

from agents import load_algorithm
from agents.common.callbacks import BlockCallback, Horizon, calls_until_multiple

ENGINES = ("compiled", "interpreted")


class Sparse(BlockCallback):
    def __init__(self, every, answers=()):
        super().__init__()
        self.every_n_steps = every
        self.answers = list(answers)
        self.seen = []

    def _on_step(self):
        table = getattr(self.model.policy, "q_table", np.zeros(1))
        self.seen.append((self.num_timesteps, self.n_calls, float(np.sum(table))))
        return self.answers.pop(0) if self.answers else True


def agent(engine, n_envs=1, **kwargs):
    env = make_vec_env("FrozenLake-v1", n_envs, seed=0)
    return load_algorithm("qlearning")(env=env, seed=0, engine=engine, **kwargs)


def both(n_envs, make, **kwargs):
    seen = {}
    for engine in ENGINES:
        callback, model = make(), agent(engine, n_envs)
        model.learn(2_000, callback=callback, **kwargs)
        model.learn(333, callback=callback, reset_num_timesteps=False)
        assert model.engine_in_use.startswith(engine)
        sparse = callback.callbacks[0] if isinstance(callback, CallbackList) else callback
        seen[engine] = sparse.seen
    assert seen["compiled"] == seen["interpreted"]
    return seen["compiled"]


@pytest.mark.parametrize("n_envs", [1, 3])
def test_both_engines_ask_at_the_same_steps_and_no_others(n_envs):
    seen = both(n_envs, lambda: Sparse(70))
    steps = [step for step, _, _ in seen]
    last = 2 * n_envs * -(-2_000 // n_envs)
    expected = [n_envs * -(-due // n_envs) for due in range(70, last, 70)]
    assert steps == expected[: len(steps)]
    assert len(steps) == 2_333 // 70
    assert [calls for _, calls, _ in seen] == [step // n_envs for step in steps]


def test_other_callbacks_that_act_in_between_change_nothing():
    def beside():
        return CallbackList(
            [Sparse(70), EveryNTimesteps(13, Sparse(1)), StopTrainingOnMaxEpisodes(10**6)]
        )

    assert both(1, beside) == both(1, lambda: Sparse(70))


def test_more_environments_than_steps_in_between():
    assert [step for step, _, _ in both(8, lambda: Sparse(3))][:3] == [8, 16, 24]


@pytest.mark.parametrize("engine", ENGINES)
def test_it_can_stop_the_training(engine):
    model = agent(engine)
    model.learn(2_000, callback=Sparse(100, [True, True, False]))
    assert model.num_timesteps == 300


def test_algorithms_of_the_library_ask_at_these_steps_too():
    callback = Sparse(20)
    DQN("MlpPolicy", "CartPole-v1", learning_starts=1000).learn(70, callback=callback)
    assert [step for step, _, _ in callback.seen] == [20, 40, 60]


@pytest.mark.parametrize("every", [0, -5, 2.5, "10"])
def test_what_is_no_number_of_steps_is_refused(every):
    with pytest.raises(ValueError, match=r"Sparse.every_n_steps must be a number from 1 on, not"):
        agent("compiled").learn(10, callback=Sparse(every))


class Reader(BlockCallback):
    """Records something and reads what is there, every fifty calls."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def horizon(self):
        return Horizon(calls=calls_until_multiple(self.n_calls, 50))

    def _on_step(self):
        if self.n_calls % 50 == 0:
            self.seen.append((self.n_calls, dict(self.logger.name_to_value)))
            self.logger.record("mine", self.n_calls)
            self.logger.record_mean("mean", self.n_calls)
        return True


class Writer(KVWriter):
    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        self.rows.append((step, key_values["train/n_updates"]))


class Watched(Logger):
    """A logger of one's own."""

    dumped = 0

    def dump(self, step=0):
        self.dumped += 1
        super().dump(step)


def with_logger(engine, logger, log_interval=7, level=None):
    callback, model = Reader(), agent(engine)
    if logger is not None:
        model.set_logger(logger)
    if level is not None:
        logger.set_level(level)
    model.learn(1_500, callback=callback, log_interval=log_interval)
    return model, callback.seen


def test_what_callbacks_record_is_forgotten_when_a_log_is_due_though_nobody_reads_it():
    read = with_logger("interpreted", Watched(None, []))[1]
    assert with_logger("compiled", None)[1] == read
    assert with_logger("interpreted", None)[1] == read
    assert any(not there for _, there in read[1:]), "forgotten"
    never = with_logger("compiled", None, log_interval=None)[1]
    assert all(there for _, there in never[1:])
    assert never != read


@pytest.mark.parametrize("engine", ENGINES)
def test_whoever_reads_the_log_gets_all_of_it(engine):
    writer = Writer()
    with_logger(engine, Logger(None, [writer]))
    assert len(writer.rows) > 10
    watched = Watched(None, [])
    with_logger(engine, watched)
    assert watched.dumped == len(writer.rows)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_logger_that_is_disabled_keeps_what_is_recorded(engine):
    logger = Logger(None, [])
    _, seen = with_logger(engine, logger, level=DISABLED)
    assert "train/n_updates" in seen[-1][1]


def test_nothing_is_worked_out_for_nobody(monkeypatch):
    model, worked_out = agent("compiled"), []
    monkeypatch.setattr(type(model), "_record_training", lambda self: worked_out.append(1))
    model.learn(2_000, log_interval=1)
    assert not worked_out


class Plain(BaseCallback):
    """As a user writes it."""

    seen = 0

    def _on_step(self):
        self.seen += 1
        return True


def test_a_plain_callback_in_the_librarys_own_wrapper_compiles():
    model, plain = agent("auto"), Plain()
    model.learn(1_000, callback=EveryNTimesteps(100, plain))
    assert model.engine_in_use == "compiled"
    assert plain.seen == 10

"""Logs of compiled trainings say what those of interpreted ones say, whatever reads them."""

import csv
import json
import math
import struct

import numpy as np
import pytest
from stable_baselines3.common.callbacks import EvalCallback, LogEveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from agents import load_algorithm
from agents.common.callbacks import BlockCallback
from agents.compiled.records import event_bytes, window_means

LAKE, WAREHOUSE = "FrozenLake-v1", "envs:Warehouse-v0"
OF_THE_CLOCK = ("time/fps", "time/time_elapsed")


class Recorder(BlockCallback):
    """Records something of its own now and then, which goes into the next record alone."""

    every_n_steps = 130

    def _on_step(self):
        self.logger.record("mine", self.num_timesteps)
        self.logger.record_mean("mean", self.n_calls)
        self.logger.record("text", "said", exclude="tensorboard")
        return True


def beside():
    """What dumps the logger by itself."""
    evaluation = EvalCallback(make_vec_env(LAKE, 1, seed=9), eval_freq=701, verbose=0)
    return [evaluation, LogEveryNTimesteps(1111), Recorder()]


def events_in(folder):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    return {
        tag: [(event.step, event.value) for event in found.Scalars(tag)]
        for tag in found.Tags()["scalars"]
        if tag not in OF_THE_CLOCK
    }


def without_clock(row):
    return {key: value for key, value in row.items() if key not in OF_THE_CLOCK}


def logs(engine, algo, env_id, n_envs, log_interval, callbacks, settings, folder):
    """All that the logger's outputs have written of two trainings, one after the other."""
    env = make_vec_env(env_id, n_envs, seed=1)
    model = load_algorithm(algo)(env=env, seed=2, engine=engine, **settings)
    model.set_logger(configure(str(folder), ["tensorboard", "csv", "json", "log"]))
    model.learn(3000, log_interval=log_interval, callback=callbacks())
    go_on = {"reset_num_timesteps": False, "callback": callbacks()}
    model.learn(1000, log_interval=log_interval, **go_on)
    assert model.engine_in_use.startswith(engine)
    model.logger.close()
    with (folder / "progress.csv").open() as file:
        rows = [without_clock(row) for row in csv.DictReader(file)]
    lines = (folder / "progress.json").read_text().splitlines()
    shown = [line.split() for line in (folder / "log.txt").read_text().splitlines()]
    text = [words for words in shown if words[0] == "|" and words[1] not in ("fps", "time_elapsed")]
    return events_in(folder), rows, [without_clock(json.loads(line)) for line in lines], text


@pytest.mark.parametrize(
    ("algo", "env_id", "n_envs", "log_interval", "callbacks", "settings"),
    [
        ("qlearning", LAKE, 1, 100, list, {}),
        ("qlearning", LAKE, 3, 4, list, {}),
        ("qlearning", LAKE, 1, 7, beside, {}),
        ("double_qlearning", WAREHOUSE, 2, 1, list, {"stats_window_size": 5}),
        ("sarsa", LAKE, 1, 5, list, {"exploration": "gaussian_noise", "noise_std": 3.0}),
        ("monte_carlo", LAKE, 1, 5, list, {}),
        ("semi_gradient_sarsa", LAKE, 2, 5, list, {}),
        ("actor_critic", LAKE, 1, 5, list, {}),
    ],
)
def test_each_output_has_the_same_records(
    algo, env_id, n_envs, log_interval, callbacks, settings, tmp_path
):
    interpreted, compiled = (
        logs(engine, algo, env_id, n_envs, log_interval, callbacks, settings, tmp_path / engine)
        for engine in ("interpreted", "compiled")
    )
    np.testing.assert_equal(compiled, interpreted)
    assert len(compiled[1]) >= 2
    assert len(compiled[0]["rollout/ep_rew_mean"]) >= 2


def test_a_block_holds_many_records():
    """Callbacks that act now and then are told of long blocks, although the log is due often."""

    class Blocks(BlockCallback):
        every_n_steps = 5000
        takes_blocks = True

        def __init__(self):
            super().__init__()
            self.n = 0

        def _on_rollout_start(self):
            self.n += 1

        def _on_step(self):
            return True

    model = load_algorithm("qlearning")(env=make_vec_env(LAKE, 1, seed=0), seed=0)
    model.set_logger(configure(None, ["log"]))
    blocks = Blocks()
    model.learn(10_000, log_interval=1, callback=blocks)
    assert blocks.n == 2
    model.logger.close()


def test_means_are_those_of_windows_added_up_one_by_one():
    values = np.random.default_rng(0).normal(size=700) * 10.0 ** np.arange(700).clip(0, 12)
    for size in (1, 3, 100, 130, 300):
        ends = np.array([1, 2, 99, 100, 101, 350, 700])
        expected = [float(np.mean(values[max(end - size, 0) : end].tolist())) for end in ends]
        assert window_means(values, ends, size) == expected


def test_events_are_those_that_tensorboard_writes():
    """Byte for byte, the framing and its checksums too."""
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c

    tags, steps = ["a", "rollout/ep_rew_mean", "über"], np.array([0, 1, 127, 128, 2**40])
    numbers = np.array([[0.0, -1.5, math.inf, 1e-40, 3.4e38]] * 3, dtype="<f4")
    numbers[2] = np.nan
    times = 1.7e9 + np.arange(5) / 3
    expected = b""
    for k, step in enumerate(steps.tolist()):
        for tag, number in zip(tags, numbers[:, k].tolist(), strict=True):
            value = Summary.Value(tag=tag, simple_value=number)
            event = Event(wall_time=times[k], step=step, summary=Summary(value=[value]))
            data = event.SerializeToString()
            head = struct.pack("<Q", len(data))
            expected += head + struct.pack("<I", masked_crc32c(head))
            expected += data + struct.pack("<I", masked_crc32c(data))
    assert event_bytes(tags, numbers, steps, times) == expected

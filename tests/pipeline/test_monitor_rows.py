"""What Monitor remembers of all episodes is in no state, and is there again after a resume."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from pipeline.auto_settings import resolved_spec
from pipeline.resuming.monitor_rows import LENGTHS, RETURNS, TIMES
from pipeline.resuming.state_keeping import SaveInterval, StateKeeping
from pipeline.resuming.state_saver import StateSaver
from pipeline.resuming.unfinished_runs import go_on, recorded_training
from pipeline.settings.hyperparams import override, read_hyperparams, split
from pipeline.training import carry_out, prepare

LAKE = "FrozenLake-v1"
OFF = StateKeeping(SaveInterval(is_off=True))
# Ten rewards of 0.1 are not 1.
FINE = {"env_kwargs": {"reward_schedule": (1.7, -0.3, 0.1)}}


class PowerCutError(BaseException):
    """The end of a process, in which nothing can be done any more."""


def spec_of(folder, settings):
    raw = override({**read_hyperparams("qlearning", LAKE, None), "n_timesteps": 3000}, settings)
    raw.pop("n_episodes", None)
    common = {"seed": 3, "log_folder": folder, "verbose": 0, "pictures": False}
    return resolved_spec(raw, algo="qlearning", env_id=LAKE, eval_freq=-1, **common)


def training_of(spec, keeping, run=None):
    return prepare(spec, Console(quiet=True), {}, "", run, keeping)


def remembered(training):
    """Returns and lengths in each Monitor, and how many times it holds."""
    lists = zip(
        *(training.model.get_env().get_attr(n) for n in (RETURNS, LENGTHS, TIMES)), strict=True
    )
    return [(returns, lengths, len(times)) for returns, lengths, times in lists]


def cut_off(spec, monkeypatch):
    """A run that was killed after its second state; and what that state left to the files."""
    training = training_of(spec, StateKeeping(SaveInterval(steps=1000)))

    def on_step(saver):
        if saver.n_saved == 2:
            raise PowerCutError
        return True

    with monkeypatch.context() as context:
        context.setattr("pipeline.training.give_up", lambda *_: None)
        context.setattr(StateSaver, "_on_step", on_step)
        with pytest.raises(PowerCutError):
            carry_out(training)
    return training.run


def gone_on(run):
    spec = replace(recorded_training(run, ()), verbose=0, pictures=False)
    keeping = go_on(run, OFF, pytest.fail)
    training = training_of(spec, keeping, run)
    carry_out(training)
    return training, keeping.state.note["episodes"]


@pytest.mark.parametrize("settings", [{}, FINE], ids=["whole returns", "others"])
@pytest.mark.parametrize("engine", ["compiled", "interpreted"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_monitor_remembers_what_it_would_have(tmp_path, monkeypatch, settings, engine, n_envs):
    settings = {**settings, "engine": engine, "n_envs": n_envs}
    whole = training_of(spec_of(tmp_path / "whole", settings), OFF)
    carry_out(whole)
    run = cut_off(spec_of(tmp_path / "parts", settings), monkeypatch)
    again, left_to_files = gone_on(run)
    assert remembered(again) == remembered(whole)
    assert type(again.model.get_env().get_attr(LENGTHS)[0][0]) is int
    names = [LENGTHS, TIMES] if "env_kwargs" in settings else [RETURNS, LENGTHS, TIMES]
    assert left_to_files == {f"{i}.monitor.csv": names for i in range(n_envs)}


def test_what_a_file_does_not_say_all_of_is_in_the_state(tmp_path, monkeypatch):
    spec = spec_of(tmp_path, {"engine": "interpreted"})
    start = StateSaver._on_training_start

    def forgetful(saver):
        start(saver)
        saver.training_env.get_attr(RETURNS)[0].append(-7.5)

    monkeypatch.setattr(StateSaver, "_on_training_start", forgetful)
    again, left_to_files = gone_on(cut_off(spec, monkeypatch))
    assert left_to_files == {}
    assert remembered(again)[0][0][0] == -7.5


def test_states_do_not_grow_with_the_number_of_episodes(tmp_path, monkeypatch):
    sizes = []
    save = StateSaver.save

    def weighed(saver):
        save(saver)
        files = saver.run.state_path.glob("*.state")
        sizes.append(max(files, key=lambda path: path.stat().st_mtime_ns).stat().st_size)

    monkeypatch.setattr(StateSaver, "save", weighed)
    spec = spec_of(tmp_path, {"engine": "compiled"})
    raw = {**spec.saved_hyperparams, "n_timesteps": 200_000}
    spec = replace(spec, hyperparams=split(raw), saved_hyperparams=raw)
    training = training_of(spec, StateKeeping(SaveInterval(steps=20_000)))
    carry_out(training)
    n_episodes = len(training.model.get_env().get_attr(RETURNS)[0])
    assert n_episodes > 5000
    assert np.ptp(sizes) < 1000, json.dumps(sizes)

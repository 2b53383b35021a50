"""What Monitor remembers of all episodes is there again after a resume."""

from dataclasses import replace

import pytest
from rich.console import Console

from pipeline.agent_settings import resolved_spec
from pipeline.settings.hyperparams import override, read_hyperparams
from pipeline.state_saver import StateSaver
from pipeline.training import carry_out, prepare
from pipeline.unfinished_runs import SaveInterval, StateKeeping, go_on, recorded_training

LAKE = "FrozenLake-v1"
RETURNS, LENGTHS, TIMES = "episode_returns", "episode_lengths", "episode_times"
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
    """A run that was killed after its second state."""
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
    return training


@pytest.mark.parametrize("settings", [{}, FINE], ids=["whole returns", "others"])
@pytest.mark.parametrize("engine", ["compiled", "interpreted"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_monitor_remembers_what_it_would_have(tmp_path, monkeypatch, settings, engine, n_envs):
    settings = {**settings, "engine": engine, "n_envs": n_envs}
    whole = training_of(spec_of(tmp_path / "whole", settings), OFF)
    carry_out(whole)
    run = cut_off(spec_of(tmp_path / "parts", settings), monkeypatch)
    again = gone_on(run)
    assert remembered(again) == remembered(whole)
    assert type(again.model.get_env().get_attr(LENGTHS)[0][0]) is int


def test_so_is_what_its_file_does_not_say(tmp_path, monkeypatch):
    spec = spec_of(tmp_path, {"engine": "interpreted"})
    start = StateSaver._on_training_start

    def forgetful(saver):
        start(saver)
        saver.training_env.get_attr(RETURNS)[0].append(-7.5)

    monkeypatch.setattr(StateSaver, "_on_training_start", forgetful)
    again = gone_on(cut_off(spec, monkeypatch))
    assert remembered(again)[0][0][0] == -7.5

"""A training that is cut off and resumed ends in the bits of one that nobody disturbed."""

import io
import json
import shutil
import signal
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from rl_yardstick.agents.compiled import engine as compiled_engine
from rl_yardstick.pipeline import state_files, state_saver
from rl_yardstick.pipeline.agent_settings import resolved_spec
from rl_yardstick.pipeline.digests import LOCK
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation import sampled
from rl_yardstick.pipeline.runs import at_work_on
from rl_yardstick.pipeline.settings.hyperparams import override, read_hyperparams
from rl_yardstick.pipeline.stopping import stops_noticed
from rl_yardstick.pipeline.training import carry_out, prepare
from rl_yardstick.pipeline.unfinished_runs import (
    SaveInterval,
    StateKeeping,
    go_on,
    newest_unfinished,
    recorded_training,
    tell_changes,
)
from rl_yardstick.pipeline.user_modules import import_typed

COMPILED = {"engine": "compiled"}
GRID, LEFT_RIGHT, SWING = "FrozenLake-v1", "CartPole-v1", "Pendulum-v1"
SMALL = {"n_steps": 64, "batch_size": 32, "n_envs": 2, "n_epochs": 2}
EAGER = {"learning_starts": 50, "buffer_size": 500, "batch_size": 16, "n_envs": 1}
LAGGING = {"n_steps": 3, "train_freq": 4, "target_update_interval": 30, "tau": 0.7}
BRIEF = {"env_kwargs": {"max_episode_steps": 25}}
STACKED = {"normalize": True, "frame_stack": 2}
NOISE = {"noise_type": "ornstein-uhlenbeck", "noise_std": 0.1}
# Ten rewards of 0.1 are not 1: what Monitor adds up depends on the order.
FINE = {"env_kwargs": {"reward_schedule": (1.7, -0.3, 0.1)}}
EACH_7 = {"rl_yardstick.pipeline.callbacks.EpisodeCheckpoint": {"every_n_episodes": 7}}
FALLING = {"callback": [EACH_7, "rl_yardstick.pipeline.callbacks.ExponentialExploration"]}
OFF = StateKeeping(SaveInterval(is_off=True))


def row(env_id, algo, steps, settings=None, **more):
    """A training; an agent is trained before it, it is watched or logged where ``more`` says so."""
    settings = {} if settings is None else settings
    return pytest.param(env_id, algo, steps, settings, more, id=" ".join([algo, *settings, *more]))


# One for each place in which something is kept between two steps: what an engine hands over, an
# agent's own memory, a library's buffers, noise and statistics, and those of callbacks and logs.
TRAININGS = [
    row(GRID, "qlearning", 600, {**COMPILED, **FINE}, watch_learning="page.html"),
    row(GRID, "n_step_sarsa", 600, {**COMPILED, "n_envs": 3}),
    row(GRID, "prioritized_sweeping", 600, {"initial_q_std": 1.0, "n_envs": 2}, trained_agent=200),
    row(GRID, "dqn", 300, {**EAGER, **LAGGING, **COMPILED}, watch_learning="page.html"),
    row(LEFT_RIGHT, "ppo", 900, {**SMALL, **COMPILED, "normalize": True}, log_interval=3),
    row(SWING, "ppo", 400, {**BRIEF, **SMALL, **STACKED, "use_sde": True}),
    row(SWING, "td3", 120, {**BRIEF, **EAGER, **NOISE}),
    row(GRID, "dqn", None, {"n_episodes": 20, **EAGER, **FALLING}, save_freq=50),
]


@pytest.fixture(autouse=True)
def short_evaluations(monkeypatch):
    """As many steps as a test can wait for, shared out as ever."""
    monkeypatch.setattr(sampled, "STEPS_IN_ANY_CASE", 200)


class CutOffError(BaseException):
    """The end of a process, in which nothing can be done any more."""


def spec_of(folder, env_id, algo, n_timesteps, settings, **more):
    entry = read_hyperparams(algo, env_id, None)
    if env_id == SWING and algo != "ars":  # whose networks are large by themselves
        entry["policy_kwargs"] = {"net_arch": [16]}
    raw = override({**entry, "n_timesteps": n_timesteps}, settings)
    raw.pop("n_timesteps" if "n_episodes" in settings else "n_episodes", None)
    if "log_interval" in more:
        more["tensorboard_log"] = folder / "log"
    if "watch_learning" in more:
        more["watch_learning"] = folder / more["watch_learning"]
    common = {"seed": 3, "log_folder": folder / "logs", "verbose": 0, "pictures": False}
    common |= {"eval_episodes": None, "final_episodes": None}
    return resolved_spec(raw, algo=algo, env_id=env_id, **{**common, **more})


def training_of(spec, keeping, run=None, file=None):
    console = Console(quiet=True) if file is None else Console(file=file, width=1000)
    return prepare(spec, console, {}, "", run, keeping)


def carried_out(spec, keeping=OFF, run=None):
    training = training_of(spec, keeping, run)
    carry_out(training)
    return training


def until_cut_off(training, monkeypatch, n_states=2):
    """Train until so many states are saved, and on until one more would be."""
    save, left = state_saver.save_state, [n_states]

    def save_or_die(*args):
        left[0] -= 1
        if left[0] < 0:
            raise CutOffError
        return save(*args)

    with monkeypatch.context() as context:
        context.setattr("rl_yardstick.pipeline.training.give_up", lambda *_: None)
        context.setattr(state_saver, "save_state", save_or_die)
        with pytest.raises(CutOffError):
            carry_out(training)
    return training.run


def cut_off(spec, monkeypatch):
    """A run whose process ended, with two states in its folder."""
    every = (spec.hyperparams.n_timesteps or 120) // 6
    return until_cut_off(training_of(spec, StateKeeping(SaveInterval(steps=every))), monkeypatch)


def recorded(run):
    return replace(recorded_training(run, ()), verbose=0, pictures=False)


def gone_on(run, tell=pytest.fail):
    keeping = go_on(run, OFF, tell)
    assert keeping.state is not None
    return carried_out(recorded(run), keeping, run)


def content(path):
    """What a file of a run says, but for moments and durations."""
    if path.suffix == ".zip":
        with zipfile.ZipFile(path) as members:
            tensors = {n: members.read(n) for n in members.namelist() if n.endswith(".pth")}
        return {name: bits(th.load(io.BytesIO(data))) for name, data in tensors.items()}
    if path.suffix == ".npz":
        return {name: array.tobytes() for name, array in np.load(path).items()}
    if path.name.endswith("monitor.csv"):
        return [line.split(",")[:2] for line in path.read_text().splitlines()[1:]]
    if path.name == "run.json":
        info = json.loads(path.read_text())
        changing = ("seconds", "cpu_seconds", "files", "spec")
        return {key: info[key] for key in info if key not in changing}
    return None if path.suffix in (".png", ".pkl") else path.read_bytes()


def bits(value):
    if isinstance(value, th.Tensor):
        return value.detach().numpy().tobytes()
    if isinstance(value, dict):
        return {name: bits(held) for name, held in value.items()}
    return [bits(held) for held in value] if isinstance(value, list | tuple) else value


def assert_same(training, other):
    """All files, what each Monitor remembers, and what was noted for the page of the learning."""
    assert training.model.num_timesteps == other.model.num_timesteps
    folders = training.run.path, other.run.path
    names, others = (
        {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
        for folder in folders
    )
    assert names == others
    for name in names:
        assert content(folders[0] / name) == content(folders[1] / name), name
    for remembered in ("episode_returns", "episode_lengths"):
        lists, again = (each.model.get_env().get_attr(remembered) for each in (training, other))
        assert lists == again
    assert {type(length) for monitor in again for length in monitor} <= {int}
    if training.watch is not None:
        tables = ("moments",) if hasattr(training.watch, "moments") else ("steps", "changes")
        for name in tables:
            kept, again = (getattr(each.watch, name).rows for each in (training, other))
            assert len(kept) > 9
            assert kept.tobytes() == again.tobytes()


def events(spec):
    """What TensorBoard reads of a training's only folder, but for speeds and durations."""
    (folder,) = (spec.tensorboard_log / spec.env_id).iterdir()
    reader = EventAccumulator(str(folder))
    reader.Reload()
    names = [name for name in reader.Tags()["scalars"] if not name.startswith("time/")]
    assert len(names) > 5
    return {name: [(e.step, e.value) for e in reader.Scalars(name)] for name in names}


@pytest.mark.parametrize(("env_id", "algo", "steps", "settings", "more"), TRAININGS)
def test_the_result_is_that_of_an_undisturbed_run(
    tmp_path, monkeypatch, env_id, algo, steps, settings, more
):
    if "trained_agent" in more:
        begun = spec_of(tmp_path / "first", env_id, algo, more["trained_agent"], settings)
        more = {**more, "trained_agent": carried_out(begun).run.model_path}
    whole = carried_out(spec_of(tmp_path / "whole", env_id, algo, steps, settings, **more))
    spec = spec_of(tmp_path / "parts", env_id, algo, steps, settings, **more)
    run = cut_off(spec, monkeypatch)
    again = gone_on(run)
    assert_same(whole, again)
    assert not run.state_path.exists()
    assert ("save_freq" in more) == (len(run.checkpoints()) > 3)
    if "log_interval" in more:
        assert events(spec) == events(whole.spec)


def test_a_stop_just_after_the_engine_asked_waits_for_the_next_block(tmp_path, monkeypatch):
    """What is in the records of compiled code, the environments do not have then."""
    settings = {**COMPILED, **FINE}
    whole = carried_out(spec_of(tmp_path / "whole", GRID, "qlearning", 600, settings))
    spec = spec_of(tmp_path / "parts", GRID, "qlearning", 600, settings)
    training = training_of(spec, StateKeeping())
    ask, stopped_at = compiled_engine.wants_position, []

    def asked_and_stopped(callback):
        wanted = ask(callback)
        if training.model.num_timesteps > 100 and not stopped_at:
            assert not wanted
            stopped_at.append(training.model.num_timesteps)
            signal.raise_signal(signal.SIGTERM)
        return wanted

    with stops_noticed(), monkeypatch.context() as context:  # a signal at the worst moment
        context.setattr(compiled_engine, "wants_position", asked_and_stopped)
        assert carry_out(training).state == "interrupted"
    assert stopped_at[0] < training.model.num_timesteps < 600
    assert_same(whole, gone_on(training.run))


@pytest.fixture
def parts(tmp_path, monkeypatch):
    """An undisturbed training, and a run of it that was cut off."""
    spec = spec_of(tmp_path / "whole", GRID, "qlearning", 600, {})
    whole = carried_out(spec)
    return whole, cut_off(replace(spec, log_folder=tmp_path / "parts"), monkeypatch)


def test_cut_off_again_and_the_newest_state_damaged(parts, monkeypatch):
    """The older state serves then."""
    whole, run = parts
    for _ in range(2):
        keeping = go_on(run, StateKeeping(SaveInterval(steps=30)), pytest.fail)
        until_cut_off(training_of(recorded(run), keeping, run), monkeypatch)
    newest = max(run.state_path.glob("*.state"), key=lambda path: path.stat().st_mtime_ns)
    newest.write_bytes(newest.read_bytes()[:-5])
    told = []
    assert_same(whole, gone_on(run, told.append))
    (line,) = told
    assert "the state before it is taken" in line


def test_a_changed_log_is_refused_and_without_a_state_the_run_begins_anew(parts):
    whole, run = parts
    monitor = run.path / "0.monitor.csv"
    monitor.write_bytes(monitor.read_bytes().replace(b"0.", b"9.", 1))
    with pytest.raises(UserError, match=r"0\.monitor\.csv has changed since the run wrote it"):
        gone_on(run)
    shutil.rmtree(run.state_path)
    with at_work_on(run, pytest.fail):
        keeping = go_on(run, StateKeeping(), pytest.fail)
        assert (run.path / LOCK).exists()
    assert keeping.state is None
    assert_same(whole, carried_out(recorded(run), keeping, run))


# --- what is refused, and what is told -----------------------------------------------------------


def test_the_newest_unfinished_run_and_a_state_of_other_settings(parts, monkeypatch):
    whole, run = parts
    logs = run.path.parents[1]
    carried_out(replace(whole.spec, log_folder=logs))
    assert newest_unfinished(logs, "qlearning", GRID).path == run.path
    other = cut_off(replace(whole.spec, log_folder=logs, seed=4), monkeypatch)
    for path in run.state_path.iterdir():
        (other.state_path / path.name).write_bytes(path.read_bytes())
    with pytest.raises(UserError, match="with other settings"):
        go_on(other, StateKeeping(), pytest.fail)
    shutil.rmtree(other.path)
    gone_on(run)
    for algo, said in (("qlearning", "all 2 are finished"), ("ppo", "none at all")):
        with pytest.raises(UserError, match=said):
            newest_unfinished(logs, algo, GRID)


def test_a_state_of_other_sources_is_told_of(tmp_path, monkeypatch):
    with monkeypatch.context() as context:  # of an older release
        context.setattr("rl_yardstick.pipeline.state_files.source_digest", lambda: "older")
        run = cut_off(spec_of(tmp_path, GRID, "qlearning", 600, {}), monkeypatch)
    told = []
    go_on(run, StateKeeping(), told.append)
    (line,) = told
    assert "was saved by other code of Yardstick, so the result may differ" in line


def test_what_has_changed_since_the_run_began_is_told(tmp_path, monkeypatch):
    begun = carried_out(spec_of(tmp_path / "first", GRID, "qlearning", 300, {}))
    agent, module = tmp_path / "agent.zip", tmp_path / "things_of_mine.py"
    agent.write_bytes(begun.run.model_path.read_bytes())
    module.write_text("x = 1\n")
    monkeypatch.setattr(sys, "path", [*sys.path])
    mine = {"user_modules": import_typed([str(module)]), "gym_packages": ("things_of_mine",)}
    spec = replace(spec_of(tmp_path, GRID, "qlearning", 600, {}, **mine), trained_agent=agent)
    run, told = cut_off(spec, monkeypatch), []
    again = recorded_training(run, spec.user_modules)
    tell_changes(run, again, told.append)
    assert told == []
    module.write_text("x = 2\n")
    agent.write_bytes(b"another")
    tell_changes(run, again, told.append)
    assert [line.split()[0] for line in told] == [str(module), str(agent)]


def test_a_full_disk_is_said_once_and_ends_no_training(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(state_files, "write_state", fail)
    spec = spec_of(tmp_path, GRID, "qlearning", 300, {})
    file = io.StringIO()
    training = training_of(spec, StateKeeping(SaveInterval(steps=50), stays=True), None, file)
    assert carry_out(training).state == "finished"
    text = " ".join(file.getvalue().split())
    assert text.count("state was saved") == 1
    assert f"no state was saved: {training.run.state_path}: No space left on dev" in text

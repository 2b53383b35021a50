"""A training that is cut off and gone on with ends in the bits of one that nobody disturbed."""

import gc
import io
import json
import os
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch as th
from rich.console import Console

from agents import ALGORITHMS
from pipeline import state_files
from pipeline.agent_settings import resolved_spec
from pipeline.digests import LOCK
from pipeline.errors import UserError
from pipeline.evaluation import sampled
from pipeline.runs import Run, at_work_on
from pipeline.settings.hyperparams import override, read_hyperparams, split
from pipeline.state_files import SavedState
from pipeline.state_saver import StateSaver
from pipeline.states import Pickled
from pipeline.training import carry_out, prepare, train
from pipeline.unfinished_runs import (
    SaveInterval,
    StateKeeping,
    cut_back,
    go_on,
    log_positions,
    newest_unfinished,
    recorded_training,
    tell_changes,
)
from pipeline.user_modules import import_typed

GRID, LEFT_RIGHT, SWING = "FrozenLake-v1", "CartPole-v1", "Pendulum-v1"
ARMS, LINEAR = "BernoulliBandit-v0", "LinearBandit-v0"
SMALL = {"n_steps": 64, "batch_size": 32, "n_envs": 2, "n_epochs": 2}
EAGER = {"learning_starts": 50, "buffer_size": 500, "batch_size": 16, "n_envs": 1}
LAGGING = {"n_steps": 3, "train_freq": 4, "target_update_interval": 30, "tau": 0.7}

SPARING = {
    "n_steps": 1,
    "optimize_memory_usage": True,
    "replay_buffer_kwargs": {"handle_timeout_termination": False},
}

# Every agent, and the settings whose state is kept in a place of its own.
TRAININGS = [
    (GRID, "qlearning", 600, {"engine": "compiled"}),
    (GRID, "qlearning", 600, {"engine": "interpreted", "n_envs": 3}),
    (GRID, "sarsa", 600, {"engine": "compiled", "n_envs": 3}),
    (GRID, "sarsa", 600, {"engine": "interpreted"}),
    ("Warehouse-v0", "expected_sarsa", 600, {"mask_actions": True}),
    (GRID, "double_qlearning", 600, {"learning_rate": "lin_0.5"}),
    (GRID, "n_step_sarsa", 600, {"engine": "compiled", "n_envs": 3}),
    ("Warehouse-v0", "n_step_tree_backup", 600, {"engine": "interpreted", "n_envs": 2}),
    ("Warehouse-v0", "sarsa_lambda", 600, {"engine": "compiled", "trace_type": "dutch"}),
    ("Warehouse-v0", "q_lambda", 600, {"engine": "interpreted", "n_envs": 3}),
    ("Warehouse-v0", "monte_carlo", 600, {"engine": "interpreted"}),
    (GRID, "off_policy_monte_carlo", 600, {"engine": "compiled", "n_envs": 3}),
    (LEFT_RIGHT, "qlearning", 600, {"engine": "compiled"}),
    (GRID, "qlearning_ucb", 600, {"value_bound": 1.0}),
    (GRID, "dyna_q", 600, {"outcomes_kept": 3, "n_envs": 2}),
    (GRID, "dyna_q_plus", 600, {"engine": "interpreted"}),
    (GRID, "prioritized_sweeping", 600, {"initial_q_std": 1.0, "n_envs": 2}),
    (GRID, "r_max", 600, {"known_after": 3, "value_bound": 1.0}),
    (GRID, "semi_gradient_sarsa", 600, {"engine": "compiled", "n_envs": 3}),
    ("MountainCar-v0", "semi_gradient_q", 600, {"engine": "interpreted"}),
    (GRID, "actor_critic", 600, {"gamma_power": True, "n_envs": 2}),
    # Cut off in the middle of episodes.
    (LEFT_RIGHT, "reinforce", 600, {"engine": "compiled"}),
    (GRID, "reinforce", 600, {"engine": "interpreted", "n_envs": 2}),
    (GRID, "value_iteration", 300, {}),
    (GRID, "policy_iteration", 300, {}),
    (GRID, "optimal", 300, {}),
    (GRID, "random", 300, {}),
    (LEFT_RIGHT, "angle", 300, {}),
    (LEFT_RIGHT, "dqn", 300, {**EAGER, "n_steps": 3, "exploration_fraction": 0.5}),
    (LEFT_RIGHT, "dqn", 300, {**EAGER, **SPARING}),
    ("Warehouse-v0", "double_dqn", 300, {**EAGER, "mask_actions": True}),
    ("Warehouse-v0", "deep_qlearning", 200, {}),
    # Long enough for `auto` to compile it, as a whole and for what is left.
    (GRID, "double_dqn", 5000, {**EAGER}),
    (LEFT_RIGHT, "ppo", 600, {**SMALL, "learning_rate": "lin_0.001", "clip_range": "lin_0.2"}),
    (SWING, "ppo", 600, {**SMALL, "use_sde": True, "normalize": True, "frame_stack": 2}),
    (LEFT_RIGHT, "a2c", 300, {}),
    # Cut off in the middle of rollouts, and after some moves of the target network.
    (LEFT_RIGHT, "ppo", 600, {**SMALL, "engine": "compiled", "learning_rate": "lin_0.001"}),
    (LEFT_RIGHT, "ppo", 600, {**SMALL, "engine": "compiled", "normalize": True}),
    (GRID, "dqn", 300, {**EAGER, **LAGGING, "engine": "compiled"}),
    (GRID, "a2c", 300, {"n_envs": 2, "n_steps": 7, "engine": "compiled"}),
    (SWING, "sac", 200, {**EAGER, "use_sde": True, "normalize": True}),
    (SWING, "td3", 200, {**EAGER, "noise_type": "ornstein-uhlenbeck", "noise_std": 0.1}),
    (SWING, "ddpg", 200, {**EAGER, "noise_type": "normal", "noise_std": 0.1}),
    (LEFT_RIGHT, "qrdqn", 200, EAGER),
    (SWING, "tqc", 150, EAGER),
    (SWING, "crossq", 150, EAGER),
    (LEFT_RIGHT, "trpo", 400, {"n_steps": 64, "batch_size": 32, "n_envs": 1}),
    (SWING, "ars", 4000, {"n_delta": 2, "n_top": 1, "n_envs": 1, "normalize": True}),
    (LEFT_RIGHT, "ppo_lstm", 400, {**SMALL, "policy_kwargs": {"lstm_hidden_size": 16}}),
    ("Warehouse-v0", "ppo_mask", 400, SMALL),
    *((ARMS, name, 300, {}) for name in ("epsilon_greedy", "boltzmann", "ucb", "kl_ucb")),
    *((ARMS, name, 300, {}) for name in ("gradient_bandit", "exp3", "thompson")),
    *((LINEAR, name, 300, {}) for name in ("linucb", "lin_thompson", "lin_epsilon_greedy")),
    *((ARMS, f"mabwiser_{name}", 200, {}) for name in ("epsilon_greedy", "ucb1", "thompson")),
    (LINEAR, "mabwiser_linucb", 200, {}),
]


@pytest.fixture(autouse=True)
def short_evaluations(monkeypatch):
    """As many steps as a test can wait for, shared out as ever."""
    monkeypatch.setattr(sampled, "STEPS_IN_ANY_CASE", 600)


class CutOffError(BaseException):
    """The end of a process, in which nothing can be done any more."""


def spec_of(folder, env_id, algo, n_timesteps, settings, **more):
    entry = read_hyperparams(algo, env_id, None) if settings is not EAGER else {}
    if env_id == SWING and algo != "ars":  # whose networks are large by themselves
        entry["policy_kwargs"] = {"net_arch": [16]}
    raw = override({**entry, "n_timesteps": n_timesteps}, settings)
    raw.pop("n_episodes", None)
    common = {"seed": 3, "log_folder": folder, "verbose": 0, "pictures": False}
    sparing = {"eval_episodes": None, "final_episodes": None}
    return resolved_spec(raw, algo=algo, env_id=env_id, **{**common, **sparing, **more})


def training_of(spec, keeping, run=None):
    return prepare(spec, Console(quiet=True), {}, "", run, keeping)


OFF = StateKeeping(SaveInterval(is_off=True))


def undisturbed(spec):
    return train(spec, Console(quiet=True), {}, "", keeping=OFF)


def until_cut_off(training, monkeypatch, n_states=2, steps=7):
    """Train until so many states were saved, and some calls more."""
    last, calls = training.saver.n_saved + n_states, [steps]

    def on_step(saver):
        calls[0] -= saver.n_saved >= last
        if calls[0] < 0:
            raise CutOffError
        return True

    with monkeypatch.context() as context:
        context.setattr("pipeline.training.give_up", lambda *_: None)
        context.setattr(StateSaver, "_on_step", on_step)
        with pytest.raises(CutOffError):
            carry_out(training)


def cut_off(spec, monkeypatch, every=None):
    """A run whose process ended, with two states or more in its folder."""
    every = every or spec.hyperparams.n_timesteps // 6
    training = training_of(spec, StateKeeping(SaveInterval(steps=every)))
    until_cut_off(training, monkeypatch)
    return training.run


def gone_on(run):
    spec = replace(recorded_training(run, ()), verbose=0, pictures=False)
    keeping = go_on(run, StateKeeping(SaveInterval(is_off=True)), pytest.fail)
    assert keeping.state is not None
    return carry_out(training_of(spec, keeping, run))


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
        return {
            key: info[key] for key in info if key not in ("seconds", "cpu_seconds", "files", "spec")
        }
    if path.suffix in (".png", ".pkl"):
        return None
    return path.read_bytes()


def bits(value):
    if isinstance(value, th.Tensor):
        return value.detach().numpy().tobytes()
    if isinstance(value, dict):
        return {name: bits(held) for name, held in value.items()}
    return [bits(held) for held in value] if isinstance(value, list | tuple) else value


def assert_same(run, other):
    names, others = (
        {str(path.relative_to(folder.path)) for path in folder.path.rglob("*") if path.is_file()}
        for folder in (run, other)
    )
    assert names == others
    for name in names:
        assert content(run.path / name) == content(other.path / name), name


@pytest.mark.parametrize(("env_id", "algo", "steps", "settings"), TRAININGS)
def test_the_result_is_that_of_an_undisturbed_run(
    tmp_path, monkeypatch, env_id, algo, steps, settings
):
    whole = undisturbed(spec_of(tmp_path / "whole", env_id, algo, steps, settings))
    run = cut_off(spec_of(tmp_path / "parts", env_id, algo, steps, settings), monkeypatch)
    outcome = gone_on(run)
    assert outcome.n_steps == whole.n_steps
    assert_same(whole.run, run)
    assert not run.state_path.exists()


def test_every_agent_is_tried():
    assert {algo for _, algo, _, _ in TRAININGS} == set(ALGORITHMS)


@pytest.mark.parametrize(
    ("env_id", "algo", "settings"),
    [
        (GRID, "qlearning", {"engine": "compiled"}),
        (GRID, "sarsa", {"engine": "interpreted", "n_envs": 3}),
        (ARMS, "thompson", {}),
        (LINEAR, "linucb", {}),
    ],
)
def test_so_it_is_where_a_trained_agent_goes_on(tmp_path, monkeypatch, env_id, algo, settings):
    begun = undisturbed(spec_of(tmp_path / "first", env_id, algo, 200, settings))
    trained = {"trained_agent": begun.run.model_path}
    whole = undisturbed(spec_of(tmp_path / "whole", env_id, algo, 600, settings, **trained))
    run = cut_off(spec_of(tmp_path / "parts", env_id, algo, 600, settings, **trained), monkeypatch)
    assert gone_on(run).n_steps == whole.n_steps > 600
    assert_same(whole.run, run)


@pytest.mark.parametrize(
    ("algo", "settings"),
    [
        ("double_qlearning", {}),
        ("dqn", EAGER),
        ("ppo", {"n_steps": 16, "batch_size": 16, "n_envs": 1, "engine": "compiled"}),
    ],
)
def test_a_run_that_is_watched_goes_on_being_watched(tmp_path, monkeypatch, algo, settings):
    watched = {"watch_learning": tmp_path / "page.html"}
    whole = training_of(spec_of(tmp_path / "whole", GRID, algo, 300, settings, **watched), OFF)
    carry_out(whole)
    spec = spec_of(tmp_path / "parts", GRID, algo, 300, settings, **watched)
    run = cut_off(spec, monkeypatch)
    keeping = go_on(run, StateKeeping(SaveInterval(is_off=True)), pytest.fail)
    recorded = replace(recorded_training(run, ()), verbose=0, pictures=False)
    assert recorded.watch_learning == watched["watch_learning"]
    rest = training_of(recorded, keeping, run)
    carry_out(rest)
    tables = ("steps", "moves", "changes") if algo == "double_qlearning" else ("moments",)
    for name in tables:
        kept, again = (getattr(training.watch, name).rows for training in (whole, rest))
        assert len(kept) > 9
        assert kept.tobytes() == again.tobytes()


def test_a_state_makes_the_difference(tmp_path, monkeypatch):
    """Of generators that are not put back, the weights tell."""
    spec = spec_of(tmp_path / "whole", LEFT_RIGHT, "dqn", 300, EAGER)
    whole = undisturbed(spec)
    run = cut_off(replace(spec, log_folder=tmp_path / "parts"), monkeypatch)
    monkeypatch.setattr("pipeline.state_saver.set_generators", lambda _: None)
    gone_on(run)
    assert content(whole.run.model_path) != content(run.model_path)


@pytest.mark.parametrize("algo", ["qlearning", "dqn"])
def test_budgets_in_episodes_callbacks_and_checkpoints(tmp_path, monkeypatch, algo):
    settings = {"n_episodes": 30, "callback": [{"pipeline.callbacks.EpisodeCheckpoint": {}}]}
    settings["callback"][0]["pipeline.callbacks.EpisodeCheckpoint"]["every_n_episodes"] = 7
    if algo == "dqn":
        settings |= {**EAGER, "callback": [*settings["callback"], EXPLORATION]}
    spec = spec_of(tmp_path / "whole", GRID, algo, 1, settings, save_freq=50)
    raw = {**spec.saved_hyperparams, "n_episodes": settings["n_episodes"]}
    raw.pop("n_timesteps", None)
    spec = replace(spec, hyperparams=split(raw), saved_hyperparams=raw)
    whole = undisturbed(spec)
    run = cut_off(replace(spec, log_folder=tmp_path / "parts"), monkeypatch, every=20)
    gone_on(run)
    assert len(run.checkpoints()) > 3
    assert_same(whole.run, run)


EXPLORATION = "pipeline.callbacks.ExponentialExploration"


def events(folder):
    """What TensorBoard reads of a folder, but for speeds and durations."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    reader = EventAccumulator(str(folder))
    reader.Reload()
    names = [name for name in reader.Tags()["scalars"] if not name.startswith("time/")]
    return {name: [(e.step, e.value) for e in reader.Scalars(name)] for name in names}


@pytest.mark.parametrize(("algo", "interval"), [("ppo", -1), ("ppo", 3), ("a2c", -1), ("dqn", -1)])
def test_logs_go_on_in_their_folder(tmp_path, monkeypatch, algo, interval):
    settings = {"ppo": SMALL, "a2c": {"n_envs": 1}, "dqn": EAGER}[algo]
    spec = spec_of(tmp_path / "whole", LEFT_RIGHT, algo, 1500, settings, log_interval=interval)
    undisturbed(replace(spec, tensorboard_log=tmp_path / "log"))
    parts = replace(spec, log_folder=tmp_path / "parts", tensorboard_log=tmp_path / "other")
    run = cut_off(parts, monkeypatch)
    gone_on(run)
    whole, resumed = (events(tmp_path / n / LEFT_RIGHT / f"{algo}_1") for n in ("log", "other"))
    assert len(whole) > 5
    assert resumed == whole
    assert [path.name for path in (tmp_path / "other" / LEFT_RIGHT).iterdir()] == [f"{algo}_1"]


def test_it_can_be_cut_off_again_and_again(tmp_path, monkeypatch):
    spec = spec_of(tmp_path / "whole", LEFT_RIGHT, "dqn", 600, EAGER)
    whole = undisturbed(spec)
    run = cut_off(replace(spec, log_folder=tmp_path / "parts"), monkeypatch)
    for _ in range(2):
        again = replace(recorded_training(run, ()), verbose=0, pictures=False)
        keeping = go_on(run, StateKeeping(SaveInterval(steps=50)), pytest.fail)
        until_cut_off(training_of(again, keeping, run), monkeypatch)
    gone_on(run)
    assert_same(whole.run, run)


def test_the_older_state_serves_where_the_newest_is_damaged(tmp_path, monkeypatch):
    spec = spec_of(tmp_path / "whole", GRID, "qlearning", 600, {})
    whole = undisturbed(spec)
    run = cut_off(replace(spec, log_folder=tmp_path / "parts"), monkeypatch)
    newest = max(run.state_path.glob("*.state"), key=lambda path: path.stat().st_mtime_ns)
    newest.write_bytes(newest.read_bytes()[:-5])
    told = []
    keeping = go_on(run, StateKeeping(SaveInterval(is_off=True)), told.append)
    again = replace(recorded_training(run, ()), verbose=0, pictures=False)
    carry_out(training_of(again, keeping, run))
    assert len(told) == 1
    assert "the state before it is taken" in told[0]
    assert_same(whole.run, run)


def test_a_strangers_state_is_refused(tmp_path, monkeypatch):
    run = cut_off(spec_of(tmp_path, GRID, "qlearning", 600, {}), monkeypatch)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "another user"))
    before = {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}
    with pytest.raises(UserError, match="another user or machine made it"):
        go_on(run, StateKeeping(), pytest.fail)
    assert before == {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}


def test_a_state_of_other_sources_is_told_of_and_no_bug_of_theirs_is_a_traceback(
    tmp_path, monkeypatch
):
    with monkeypatch.context() as context:
        context.setattr("pipeline.state_files.source_digest", lambda: "older")
        run = cut_off(spec_of(tmp_path, GRID, "qlearning", 600, {}), monkeypatch)
    told = []
    keeping = go_on(run, StateKeeping(), told.append)
    (line,) = told
    assert "was saved by other sources of Yardstick, so that the result may differ" in line

    def restore(*_):
        raise AttributeError("'Evaluation' object has no attribute 'new'")

    monkeypatch.setattr("pipeline.state_saver.unpickled", restore)
    again = replace(recorded_training(run, ()), verbose=0, pictures=False)
    with pytest.raises(UserError, match=r"no attribute 'new'; remove it to begin the run again$"):
        carry_out(training_of(again, keeping, run))


def test_a_state_beside_other_settings_is_refused(tmp_path, monkeypatch):
    run = cut_off(spec_of(tmp_path, GRID, "qlearning", 600, {}), monkeypatch)
    other = cut_off(spec_of(tmp_path, GRID, "sarsa", 600, {}), monkeypatch)
    for path in other.state_path.iterdir():
        (run.state_path / path.name).write_bytes(path.read_bytes())
    with pytest.raises(UserError, match="of other settings"):
        go_on(run, StateKeeping(), pytest.fail)


def test_a_run_under_way_cannot_be_taken_for_one_of_an_earlier_version(tmp_path, monkeypatch):
    run = cut_off(spec_of(tmp_path, GRID, "qlearning", 600, {}), monkeypatch)
    record = json.loads(run.info_path.read_text())
    run.info_path.write_text(json.dumps({**record, "state": "finished"}))
    with pytest.raises(UserError, match="it has lost the digests"):
        run.read_info()


def test_what_has_changed_since_the_run_began_is_told(tmp_path, monkeypatch):
    begun = undisturbed(spec_of(tmp_path / "first", GRID, "qlearning", 300, {}))
    agent, module = tmp_path / "agent.zip", tmp_path / "things_of_mine.py"
    agent.write_bytes(begun.run.model_path.read_bytes())
    module.write_text("x = 1\n")
    monkeypatch.setattr(sys, "path", [*sys.path])
    mine = {"user_modules": import_typed([str(module)]), "gym_packages": ("things_of_mine",)}
    spec = spec_of(tmp_path, GRID, "qlearning", 600, {}, trained_agent=agent, **mine)
    run, told = cut_off(spec, monkeypatch), []
    again = recorded_training(run, spec.user_modules)
    tell_changes(run, again, told.append)
    assert told == []
    module.write_text("x = 2\n")
    agent.write_bytes(b"another")
    tell_changes(run, again, told.append)
    assert [line.split()[0] for line in told] == [str(module), str(agent)]


def test_files_that_a_wrapper_begins_anew_are_no_obstacle(tmp_path):
    rows, others = tmp_path / "0.monitor.csv", tmp_path / "all.monitor.csv"
    rows.write_text("a\nb\n")
    others.write_text("a\nb\n")
    positions = log_positions(tmp_path, None)
    rows.write_text("a\nb\nc\n")
    others.write_text("a\n")
    cut_back(tmp_path, None, positions)
    assert (rows.read_text(), others.read_text()) == ("a\nb\n", "a\n")


def test_without_a_state_the_run_begins_anew(tmp_path, monkeypatch):
    spec = spec_of(tmp_path / "whole", LEFT_RIGHT, "dqn", 300, EAGER)
    whole = undisturbed(spec)
    run = cut_off(replace(spec, log_folder=tmp_path / "parts"), monkeypatch)
    for path in run.state_path.iterdir():
        path.unlink()
    with at_work_on(run, pytest.fail):
        keeping = go_on(run, StateKeeping(), pytest.fail)
        assert (run.path / LOCK).exists()
    assert keeping.state is None
    again = replace(recorded_training(run, ()), verbose=0, pictures=False)
    carry_out(training_of(again, keeping, run))
    assert_same(whole.run, run)


def test_what_cannot_be_kept_is_said_once(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr("pipeline.preparation._say", lambda _, line: told.append(line))
    spec = spec_of(tmp_path, LEFT_RIGHT, "ppo", 400, SMALL, vec_env="subproc")
    train(spec, Console(quiet=True), {}, "", keeping=StateKeeping(SaveInterval(steps=50)))
    assert len(told) == 1
    assert "environments are in other processes" in told[0]
    assert "begins it anew" in told[0]


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ("write_state", "no state was saved: {folder}: No space left on device"),
        ("user_key", "no state can be kept: the key to saved states: No space left on device"),
    ],
)
def test_what_keeps_states_from_being_saved_is_said_once_and_ends_no_training(
    tmp_path, monkeypatch, part, said
):
    def full(*_):
        raise OSError(28, "No space left on device")

    told = []
    monkeypatch.setattr("pipeline.preparation._say", lambda _, line: told.append(line))
    monkeypatch.setattr(state_files, part, full)
    spec = spec_of(tmp_path, GRID, "qlearning", 600, {})
    keeping = StateKeeping(SaveInterval(steps=50), stays=True)
    outcome = train(spec, Console(quiet=True), {}, "", keeping=keeping)
    assert outcome.state == "finished"
    assert len(told) == 1
    assert told[0].startswith(said.format(folder=outcome.run.state_path))


def test_what_a_state_is_held_against_is_on_the_disk_before_it(tmp_path, monkeypatch):
    """After a power cut a state would be there whose rows of Monitor, or whose models are not."""
    synced, fsync = [], os.fsync

    def noted(number):
        synced.append(Path(f"/proc/self/fd/{number}").readlink().name)
        fsync(number)

    monkeypatch.setattr("os.fsync", noted)
    log = {"tensorboard_log": tmp_path / "log", "log_interval": 1, "eval_freq": 50}
    cut_off(spec_of(tmp_path, LEFT_RIGHT, "ppo", 600, SMALL, **log), monkeypatch)
    before = synced[: next(i for i, name in enumerate(synced) if ".state." in name)]
    assert {"0.monitor.csv", "1.monitor.csv", "run.json", "best_model.zip"} <= {*before}
    assert any(name.startswith("events.out.tfevents") for name in before)


def test_saving_by_time_takes_its_share(tmp_path, monkeypatch):
    """However long a state takes, the next is saved fifty times as long after it."""
    clock = [0.0]
    monkeypatch.setattr("pipeline.state_saver.time.monotonic", lambda: clock[0])
    saver = StateSaver(Run(tmp_path, ""), StateKeeping(), pytest.fail)
    clock[0] = 2.4
    assert not saver.wants_position()
    clock[0] = 2.6
    assert saver.wants_position()

    def write(self):
        clock[0] += 0.5

    monkeypatch.setattr(StateSaver, "_write", write)
    monkeypatch.setattr(StateSaver, "is_off", False, raising=False)
    saver.model = type("Model", (), {"num_timesteps": 0})()
    saver.save()
    assert saver.pause == 25.0
    clock[0] += 24.9
    assert not saver.wants_position()
    clock[0] += 0.2
    assert saver.wants_position()


def test_saving_leaves_garbage_alone(tmp_path, monkeypatch):
    """To look for it among all that the libraries hold takes longer than a state."""
    seen = []
    saver = StateSaver(Run(tmp_path, ""), StateKeeping(), pytest.fail)
    monkeypatch.setattr(StateSaver, "_write", lambda _: seen.append(gc.isenabled()))
    saver.model = type("Model", (), {"num_timesteps": 0})()
    saver.save()
    assert seen == [False]
    assert gc.isenabled()


def test_no_search_for_garbage_follows_a_state(tmp_path, monkeypatch):
    kept, generations, thresholds = [], [], gc.get_threshold()
    saver = StateSaver(Run(tmp_path, ""), StateKeeping(), pytest.fail)
    monkeypatch.setattr(StateSaver, "_write", lambda _: kept.extend([[] for _ in range(5000)]))
    saver.model = type("Model", (), {"num_timesteps": 0})()
    for _ in range(4):
        gc.collect(0)
    gc.set_threshold(700, 2, 1000)  # so that the next search by itself goes beyond what is young
    gc.callbacks.append(lambda phase, info: generations.append(info["generation"]))
    try:
        saver.save()
        kept.extend([[] for _ in range(100)])
    finally:
        gc.callbacks.pop()
        gc.set_threshold(*thresholds)
    assert set(generations) == {0}


def test_what_was_cut_off_is_saved_sooner(tmp_path, monkeypatch):
    """Where it is cut off every few seconds, it gets ahead all the same."""
    clock = [0.0]
    monkeypatch.setattr("pipeline.state_saver.time.monotonic", lambda: clock[0])

    def saver_of(note, seconds=0.0, was_cut_off=True):
        state = None if note is None else SavedState(Pickled(b"", (), ()), note)
        keeping = StateKeeping(SaveInterval(seconds), state, was_cut_off=was_cut_off)
        return StateSaver(Run(tmp_path, ""), keeping, pytest.fail)

    assert saver_of(None, was_cut_off=False).pause == 2.5
    assert saver_of(None).pause == 0.1  # it was cut off before its first state
    assert saver_of({"pause": 25.0}).pause == 0.5  # what saving took
    assert saver_of({"pause": 25.0}, seconds=30.0).pause == 30.0
    gone_on = saver_of({"number": 3})
    assert gone_on.pause == 0.1

    def write(self):
        clock[0] += 0.5

    monkeypatch.setattr(StateSaver, "_write", write)
    gone_on.model = type("Model", (), {"num_timesteps": 0})()
    pauses = []
    for _ in range(6):
        gone_on.save()
        pauses.append(gone_on.pause)
    assert pauses == pytest.approx([1.2, 3.4, 7.8, 16.6, 25.0, 25.0])


def test_the_newest_unfinished_run(tmp_path, monkeypatch):
    spec = spec_of(tmp_path, GRID, "qlearning", 300, {})
    first = cut_off(spec, monkeypatch)
    undisturbed(spec)
    assert newest_unfinished(tmp_path, "qlearning", GRID).path == first.path
    gone_on(first)
    with pytest.raises(UserError, match="all 2 are finished"):
        newest_unfinished(tmp_path, "qlearning", GRID)
    with pytest.raises(UserError, match="none at all"):
        newest_unfinished(tmp_path, "sarsa", GRID)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"spec": {}}, "does not say what it was asked for"),
        ({"spec": {"env_id": GRID, "hyperparams": [1]}}, "run.json is damaged"),
        ({"spec": {"env_id": "Other-v0", "hyperparams": {}}}, "run.json is damaged"),
        ({"spec": {"env_id": 3, "hyperparams": {}}}, "run.json is damaged"),
    ],
)
def test_a_record_that_was_edited_is_refused(tmp_path, changes, said):
    run = Run.claim(tmp_path, "qlearning", GRID)
    run.update_info(**changes)
    with pytest.raises(UserError, match=said):
        recorded_training(run, ())


def test_of_versions_that_are_none_nothing_is_said(tmp_path):
    run = Run.claim(tmp_path, "qlearning", GRID)
    run.update_info(versions=["torch"])
    assert go_on(run, StateKeeping(), pytest.fail).goes_on

"""A training that is cut off and resumed ends in the bits of one that nobody disturbed."""

import io
import json
import os
import shutil
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch as th
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from agents import ALGORITHMS
from pipeline import state_files, state_saver
from pipeline.agent_settings import resolved_spec
from pipeline.digests import LOCK
from pipeline.errors import UserError
from pipeline.evaluation import sampled
from pipeline.runs import Run, at_work_on
from pipeline.settings.hyperparams import override, read_hyperparams
from pipeline.training import carry_out, prepare
from pipeline.unfinished_runs import (
    SaveInterval,
    StateKeeping,
    go_on,
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
NOISE = {"noise_type": "ornstein-uhlenbeck", "noise_std": 0.1}
SPARING = {
    "n_steps": 1,
    "optimize_memory_usage": True,
    "replay_buffer_kwargs": {"handle_timeout_termination": False},
}
# Ten rewards of 0.1 are not 1: what Monitor adds up depends on the order.
FINE = {"env_kwargs": {"reward_schedule": (1.7, -0.3, 0.1)}}

# Every agent, and the settings whose state is kept in a place of its own.
TRAININGS = [
    (GRID, "qlearning", 600, {"engine": "compiled", **FINE}),
    (GRID, "qlearning", 600, {"engine": "interpreted", "n_envs": 3, **FINE}),
    (GRID, "sarsa", 600, {"engine": "compiled", "n_envs": 3, **FINE}),
    ("Warehouse-v0", "expected_sarsa", 600, {"mask_actions": True}),
    (GRID, "double_qlearning", 600, {"learning_rate": "lin_0.5"}),
    (GRID, "n_step_sarsa", 600, {"engine": "compiled", "n_envs": 3}),
    ("Warehouse-v0", "n_step_tree_backup", 600, {"engine": "interpreted", "n_envs": 2}),
    ("Warehouse-v0", "sarsa_lambda", 600, {"engine": "compiled", "trace_type": "dutch"}),
    ("Warehouse-v0", "q_lambda", 600, {"engine": "interpreted", "n_envs": 3}),
    ("Warehouse-v0", "monte_carlo", 600, {"engine": "interpreted"}),
    (GRID, "off_policy_monte_carlo", 600, {"engine": "compiled", "n_envs": 3}),
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
    *((GRID, name, 300, {}) for name in ("value_iteration", "policy_iteration", "optimal")),
    (GRID, "random", 300, {}),
    (LEFT_RIGHT, "angle", 300, {}),
    (LEFT_RIGHT, "dqn", 300, {**EAGER, "n_steps": 3, "exploration_fraction": 0.5}),
    (LEFT_RIGHT, "dqn", 300, {**EAGER, **SPARING}),
    ("Warehouse-v0", "double_dqn", 300, {**EAGER, "mask_actions": True}),
    ("Warehouse-v0", "deep_qlearning", 200, {}),
    # Long enough for `auto` to compile it, as a whole and for what is left.
    (GRID, "double_dqn", 5000, EAGER),
    (SWING, "ppo", 600, {**SMALL, "use_sde": True, "normalize": True, "frame_stack": 2}),
    # Cut off in the middle of rollouts, and after some moves of the target network.
    (LEFT_RIGHT, "ppo", 600, {**SMALL, "engine": "compiled", "learning_rate": "lin_0.001"}),
    (LEFT_RIGHT, "ppo", 600, {**SMALL, "engine": "compiled", "normalize": True}),
    (GRID, "dqn", 300, {**EAGER, **LAGGING, "engine": "compiled"}),
    (GRID, "a2c", 300, {"n_envs": 2, "n_steps": 7, "engine": "compiled"}),
    (SWING, "sac", 200, {**EAGER, "use_sde": True, "normalize": True}),
    (SWING, "td3", 200, {**EAGER, **NOISE}),
    (SWING, "ddpg", 200, {**EAGER, "noise_type": "normal", "noise_std": 0.1}),
    (LEFT_RIGHT, "qrdqn", 200, EAGER),
    *((SWING, name, 150, EAGER) for name in ("tqc", "crossq")),
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
OFF = StateKeeping(SaveInterval(is_off=True))


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
    if "n_episodes" not in settings:
        raw.pop("n_episodes", None)
    common = {"seed": 3, "log_folder": folder, "verbose": 0, "pictures": False}
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
        context.setattr("pipeline.training.give_up", lambda *_: None)
        context.setattr(state_saver, "save_state", save_or_die)
        with pytest.raises(CutOffError):
            carry_out(training)
    return training.run


def cut_off(spec, monkeypatch, every=None):
    """A run whose process ended, with two states in its folder."""
    every = every or spec.hyperparams.n_timesteps // 6
    keeping = StateKeeping(SaveInterval(steps=every))
    return until_cut_off(training_of(spec, keeping), monkeypatch)


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
    """All files, and what each Monitor remembers."""
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


@pytest.mark.parametrize(("env_id", "algo", "steps", "settings"), TRAININGS)
def test_the_result_is_that_of_an_undisturbed_run(
    tmp_path, monkeypatch, env_id, algo, steps, settings
):
    whole = carried_out(spec_of(tmp_path / "whole", env_id, algo, steps, settings))
    run = cut_off(spec_of(tmp_path / "parts", env_id, algo, steps, settings), monkeypatch)
    again = gone_on(run)
    assert again.model.num_timesteps == whole.model.num_timesteps
    assert_same(whole, again)
    assert not run.state_path.exists()


def test_every_agent_is_tried():
    assert {algo for _, algo, _, _ in TRAININGS} == set(ALGORITHMS)


@pytest.mark.parametrize(
    ("env_id", "algo", "settings"),
    [(GRID, "sarsa", {"engine": "interpreted", "n_envs": 3}), (LINEAR, "linucb", {})],
)
def test_so_it_is_where_a_trained_agent_goes_on(tmp_path, monkeypatch, env_id, algo, settings):
    begun = carried_out(spec_of(tmp_path / "first", env_id, algo, 200, settings))
    trained = {"trained_agent": begun.run.model_path}
    whole = carried_out(spec_of(tmp_path / "whole", env_id, algo, 600, settings, **trained))
    run = cut_off(spec_of(tmp_path / "parts", env_id, algo, 600, settings, **trained), monkeypatch)
    again = gone_on(run)
    assert again.model.num_timesteps == whole.model.num_timesteps > 600
    assert_same(whole, again)


@pytest.mark.parametrize(
    ("algo", "settings", "tables"),
    [
        ("double_qlearning", {}, ("steps", "moves", "changes")),
        ("dqn", EAGER, ("moments",)),
        ("ppo", {**SMALL, "n_envs": 1, "engine": "compiled"}, ("moments",)),
    ],
)
def test_a_run_that_is_watched_goes_on_being_watched(tmp_path, monkeypatch, algo, settings, tables):
    watched = {"watch_learning": tmp_path / "page.html"}
    whole = carried_out(spec_of(tmp_path / "whole", GRID, algo, 600, settings, **watched))
    run = cut_off(spec_of(tmp_path / "parts", GRID, algo, 600, settings, **watched), monkeypatch)
    assert recorded(run).watch_learning == watched["watch_learning"]
    rest = gone_on(run)
    for name in tables:
        kept, again = (getattr(training.watch, name).rows for training in (whole, rest))
        assert len(kept) > 9
        assert kept.tobytes() == again.tobytes()


@pytest.mark.parametrize("algo", ["qlearning", "dqn"])
def test_budgets_in_episodes_callbacks_and_checkpoints(tmp_path, monkeypatch, algo):
    checkpoint = {"pipeline.callbacks.EpisodeCheckpoint": {"every_n_episodes": 7}}
    settings = {"n_episodes": 30, "callback": [checkpoint]}
    if algo == "dqn":
        settings["callback"].append("pipeline.callbacks.ExponentialExploration")
        settings |= EAGER
    raw = {**override(read_hyperparams(algo, GRID, None), settings), "n_episodes": 30}
    raw.pop("n_timesteps", None)
    common = {"verbose": 0, "pictures": False, "save_freq": 50, "log_folder": tmp_path / "whole"}
    spec = resolved_spec(raw, algo=algo, env_id=GRID, seed=3, **common)
    whole = carried_out(spec)
    run = cut_off(replace(spec, log_folder=tmp_path / "parts"), monkeypatch, every=20)
    again = gone_on(run)
    assert len(run.checkpoints()) > 3
    assert_same(whole, again)


def events(folder):
    """What TensorBoard reads of a folder, but for speeds and durations."""
    reader = EventAccumulator(str(folder))
    reader.Reload()
    names = [name for name in reader.Tags()["scalars"] if not name.startswith("time/")]
    return {name: [(e.step, e.value) for e in reader.Scalars(name)] for name in names}


@pytest.mark.parametrize(
    ("algo", "interval", "settings"),
    [("ppo", 3, SMALL), ("a2c", -1, {"n_envs": 1}), ("dqn", -1, EAGER)],
)
def test_logs_go_on_in_their_folder(tmp_path, monkeypatch, algo, interval, settings):
    spec = spec_of(tmp_path / "whole", LEFT_RIGHT, algo, 1500, settings, log_interval=interval)
    carried_out(replace(spec, tensorboard_log=tmp_path / "log"))
    parts = replace(spec, log_folder=tmp_path / "parts", tensorboard_log=tmp_path / "other")
    gone_on(cut_off(parts, monkeypatch))
    whole, resumed = (events(tmp_path / n / LEFT_RIGHT / f"{algo}_1") for n in ("log", "other"))
    assert len(whole) > 5
    assert resumed == whole
    assert [path.name for path in (tmp_path / "other" / LEFT_RIGHT).iterdir()] == [f"{algo}_1"]


@pytest.fixture
def parts(tmp_path, monkeypatch):
    """An undisturbed training with a replay buffer, and a run of it that was cut off."""
    spec = spec_of(tmp_path / "whole", LEFT_RIGHT, "dqn", 300, EAGER)
    whole = carried_out(spec)
    return whole, cut_off(replace(spec, log_folder=tmp_path / "parts"), monkeypatch)


def test_it_can_be_cut_off_again_and_again(parts, monkeypatch):
    whole, run = parts
    for _ in range(2):
        keeping = go_on(run, StateKeeping(SaveInterval(steps=30)), pytest.fail)
        until_cut_off(training_of(recorded(run), keeping, run), monkeypatch)
    assert_same(whole, gone_on(run))


def test_the_older_state_serves_where_the_newest_is_damaged(parts):
    whole, run = parts
    newest = max(run.state_path.glob("*.state"), key=lambda path: path.stat().st_mtime_ns)
    newest.write_bytes(newest.read_bytes()[:-5])
    told = []
    assert_same(whole, gone_on(run, told.append))
    (line,) = told
    assert "the state before it is taken" in line


def test_without_a_state_the_run_begins_anew(parts):
    whole, run = parts
    shutil.rmtree(run.state_path)
    with at_work_on(run, pytest.fail):
        keeping = go_on(run, StateKeeping(), pytest.fail)
        assert (run.path / LOCK).exists()
    assert keeping.state is None
    assert_same(whole, carried_out(recorded(run), keeping, run))


# --- what is refused, and what is told -----------------------------------------------------------


@pytest.fixture
def tabular(tmp_path, monkeypatch):
    return cut_off(spec_of(tmp_path, GRID, "qlearning", 600, {}), monkeypatch)


def test_a_state_beside_other_settings_is_refused(tabular, tmp_path, monkeypatch):
    other = cut_off(spec_of(tmp_path, GRID, "sarsa", 600, {}), monkeypatch)
    for path in other.state_path.iterdir():
        (tabular.state_path / path.name).write_bytes(path.read_bytes())
    with pytest.raises(UserError, match="of other settings"):
        go_on(tabular, StateKeeping(), pytest.fail)


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
    with pytest.raises(UserError, match=r"no attribute 'new'; remove it to begin the run again$"):
        carried_out(recorded(run), keeping, run)


def test_what_has_changed_since_the_run_began_is_told(tmp_path, monkeypatch):
    begun = carried_out(spec_of(tmp_path / "first", GRID, "qlearning", 300, {}))
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


def test_the_newest_unfinished_run(tabular, tmp_path):
    carried_out(spec_of(tmp_path, GRID, "qlearning", 300, {}))
    assert newest_unfinished(tmp_path, "qlearning", GRID).path == tabular.path
    gone_on(tabular)
    for algo, said in (("qlearning", "all 2 are finished"), ("sarsa", "none at all")):
        with pytest.raises(UserError, match=said):
            newest_unfinished(tmp_path, algo, GRID)


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ({}, "does not say what it was asked for"),
        ({"env_id": GRID, "hyperparams": [1]}, "run.json is damaged"),
        ({"env_id": "Other-v0", "hyperparams": {}}, "run.json is damaged"),
    ],
)
def test_a_record_that_was_edited_is_refused(tmp_path, spec, said):
    run = Run.claim(tmp_path, "qlearning", GRID)
    run.update_info(versions=["torch"])  # of which nothing is said
    assert go_on(run, StateKeeping(), pytest.fail).goes_on
    run.update_info(spec=spec)
    with pytest.raises(UserError, match=said):
        recorded_training(run, ())


FULL = OSError(28, "No space left on device")
NO_HOME = FileNotFoundError("the user has no home folder")


@pytest.mark.parametrize(
    ("part", "error", "said"),
    [
        ("write_state", FULL, "no state was saved: {folder}: No space left on device"),
        ("write_state", MemoryError(), "no state was saved: there is no memory left for it"),
        ("user_key", FULL, "no state can be kept: the key to saved states: No space left"),
        ("user_key", NO_HOME, "no state can be kept: the key to saved states: the user has no"),
        (None, None, "no state can be kept: --vec-env subproc: environments are in other proces"),
    ],
)
def test_what_keeps_states_from_being_saved_is_said_once_and_ends_no_training(
    tmp_path, monkeypatch, part, error, said
):
    def fail(*_):
        raise type(error)(*error.args)

    if part:
        monkeypatch.setattr(state_files, part, fail)
    vec_env = "dummy" if part else "subproc"
    spec = spec_of(tmp_path, GRID, "qlearning", 300, {"n_envs": 2}, vec_env=vec_env)
    file = io.StringIO()
    training = training_of(spec, StateKeeping(SaveInterval(steps=50), stays=True), None, file)
    assert carry_out(training).state == "finished"
    (line,) = [line for line in file.getvalue().splitlines() if "state" in line]
    assert line.startswith(said.format(folder=training.run.state_path))
    assert line.endswith("--resume begins it anew") == ("can be kept" in said)


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

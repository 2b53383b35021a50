"""A training that is watched, or cut off and resumed, ends in the bits of an undisturbed one."""

import io
import json
import pickle
import signal
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch as th
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from rl_yardstick.experiments.results import read_compared
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation import sampled
from rl_yardstick.pipeline.run import Run, resumable
from rl_yardstick.pipeline.settings import override, read_entry, read_spec
from tests.pipeline.short_runs import CART, LAKE, SWING, cut_off, resumed, run_of

COMPILED = {"engine": "compiled"}
SMALL = {"n_steps": 64, "batch_size": 32, "n_envs": 2, "n_epochs": 2}
EAGER = {"learning_starts": 50, "buffer_size": 500, "batch_size": 16, "n_envs": 1}
LAGGING = {"n_steps": 3, "train_freq": 4, "target_update_interval": 30, "tau": 0.7}
BRIEF = {"env_kwargs": {"max_episode_steps": 25}}
STACKED = {"normalize": True, "frame_stack": 2}
NOISE = {"noise_type": "ornstein-uhlenbeck", "noise_std": 0.1}
# Ten rewards of 0.1 are not 1: what Monitor adds up depends on the order.
FINE = {"env_kwargs": {"reward_schedule": [1.7, -0.3, 0.1]}}
FALLING = {"callback": "rl_yardstick.pipeline.callbacks.ExponentialExploration"}


def row(env_id, algo, steps, settings=None, **fields):
    settings = settings or {}
    return pytest.param(env_id, algo, steps, settings, fields, id=" ".join([algo, *settings]))


# One for each place in which something is kept between two steps: what an engine hands over, an
# agent's own memory, a library's buffers, noise and statistics, and those of callbacks and logs.
TRAININGS = [
    row(LAKE, "qlearning", 600, {**COMPILED, **FINE}, diagnose=True),
    row(LAKE, "sarsa", 600, {"engine": "interpreted", "n_envs": 2}),
    row(LAKE, "n_step_sarsa", 600, {**COMPILED, "n_envs": 3}),
    row(LAKE, "prioritized_sweeping", 600, {"initial_q_std": 1.0, "n_envs": 2}),
    row(LAKE, "dqn", 300, {**EAGER, **LAGGING, **COMPILED}),
    row(CART, "ppo", 900, {**SMALL, **COMPILED, "normalize": True}, log_interval=3),
    row(SWING, "ppo", 400, {**BRIEF, **SMALL, **STACKED, "use_sde": True}),
    row(SWING, "td3", 120, {**BRIEF, **EAGER, **NOISE}, save_replay_buffer=True),
    row(LAKE, "dqn", None, {"n_episodes": 20, **EAGER, **FALLING}, save_freq=50),
    row("SegmentBandit-v0", "linucb", 300, {}),
    row(LAKE, "ppo", 300, {**SMALL}, diagnose=True, save_every_n_episodes=7),
]


@pytest.fixture(autouse=True)
def quick_states(monkeypatch, tmp_path, quick_runs, states_at_each_moment):
    monkeypatch.chdir(tmp_path)


def spec_of(env_id, algo, steps, settings, **fields):
    entry = read_entry(algo, env_id)
    if env_id == SWING:
        entry["policy_kwargs"] = {"net_arch": [16]}
    changes = settings if steps is None else {"n_timesteps": steps, **settings}
    if "log_interval" in fields:
        fields["tensorboard_log"] = "log"
    return read_spec(algo, env_id, override(entry, changes), seed=3, pictures=False, **fields)


def content(path):
    """What a file of a run says, but for moments and durations."""
    if path.suffix == ".zip":
        with zipfile.ZipFile(path) as members:
            tensors = {n: members.read(n) for n in members.namelist() if n.endswith(".pth")}
        return {name: bits(th.load(io.BytesIO(data))) for name, data in tensors.items()}
    if "vecnormalize" in path.name:
        held = pickle.loads(path.read_bytes())
        return [each.tobytes() for each in (held.obs_rms.mean, held.ret_rms.var)]
    if path.suffix == ".npz":
        return {name: array.tobytes() for name, array in np.load(path).items()}
    if path.name.endswith("monitor.csv"):
        return [line.split(",")[:2] for line in path.read_text().splitlines()[1:]]
    if path.name == "run.json":
        info = json.loads(path.read_text())
        return {key: info[key] for key in info if "seconds" not in key}
    return path.read_bytes() if path.suffix in (".csv", ".yml") else None


def bits(value):
    if isinstance(value, th.Tensor):
        return value.detach().numpy().tobytes()
    if isinstance(value, dict):
        return {name: bits(held) for name, held in value.items()}
    return [bits(held) for held in value] if isinstance(value, list | tuple) else value


def assert_same(run, other):
    names, others = (
        {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
        for folder in (run.path, other.path)
    )
    assert names == others
    assert "state.bin" not in names
    for name in names:
        assert content(run.path / name) == content(other.path / name), name


def events(folder):
    """What TensorBoard reads of a training's only folder, but for speeds and durations."""
    (place,) = (folder / "log" / CART).iterdir()
    reader = EventAccumulator(str(place))
    reader.Reload()
    names = [name for name in reader.Tags()["scalars"] if not name.startswith("time/")]
    assert len(names) > 5
    return {name: {e.step: e.value for e in reader.Scalars(name)} for name in names}


@pytest.mark.parametrize(("env_id", "algo", "steps", "settings", "fields"), TRAININGS)
def test_the_result_is_that_of_an_undisturbed_run(
    tmp_path, monkeypatch, env_id, algo, steps, settings, fields
):
    spec = spec_of(env_id, algo, steps, settings, **fields)
    (tmp_path / "w").mkdir()
    monkeypatch.chdir(tmp_path / "w")
    whole, _ = run_of(spec, "whole")
    whole = Run((tmp_path / "w" / whole.path).absolute())
    monkeypatch.chdir(tmp_path)
    assert_same(whole, resumed(cut_off(spec, monkeypatch)))
    if "log_interval" in fields:
        assert events(tmp_path) == events(tmp_path / "w")


SHORT = {**SMALL, "gae_lambda": 0.8}
# What is noted by those who look on, and of what there are figures then.
WATCHED = [
    (CART, "ppo", {**SMALL, "normalize": True}, -1, {"eval_freq": 40}, "results"),
    (LAKE, "qlearning", COMPILED, None, {"diagnose": True}, "overestimation"),
    (LAKE, "ppo", {**SHORT, "engine": "library"}, 70, {"diagnose": True}, "gradient_cosine"),
    (LAKE, "ppo", {**SHORT, **COMPILED}, 100, {"diagnose": True}, "gae_bias"),
    (LAKE, "qlearning", {}, None, {"watch_learning": "page.html"}, "steps"),
    (LAKE, "ppo", SMALL, None, {"watch_learning": "page.html"}, "moments"),
]


@pytest.mark.parametrize(("env_id", "algo", "settings", "eval_freq", "looks", "noted"), WATCHED)
def test_who_looks_on_leaves_the_same_agent(
    monkeypatch, env_id, algo, settings, eval_freq, looks, noted
):
    monkeypatch.setattr(sampled, "STEPS_IN_ANY_CASE", 2000)
    spec = spec_of(env_id, algo, 400, settings, eval_freq=eval_freq, eval_episodes=3)
    alone, plain = run_of(spec, "alone")
    run, outcome = run_of(spec.changed(**looks), "seen")
    names = {str(path.relative_to(alone.path)) for path in alone.path.rglob("*.*")}
    for name in names - {"run.json"}:
        assert content(alone.path / name) == content(run.path / name), name
    if noted == "results":
        assert "evaluations.npz" not in names
        found = np.load(run.path / "evaluations.npz")[noted]
    elif "diagnose" in looks:
        assert "diagnosis.csv" not in names
        found = read_compared(run.path)[noted][:4]
        assert np.isfinite(found).all()
    else:
        assert outcome.engine == plain.engine
        found = getattr(outcome.watch, noted)
    assert len(found) >= 4


KILLED = """
import os, signal, sys
from rl_yardstick.commands import run_command
from rl_yardstick.pipeline.callbacks import StateCallback
StateCallback.share_of_time, StateCallback.shortest_pause = 1e9, 0.0
old = StateCallback._on_rollout_start
def new(self):
    old(self)
    if self.model.num_timesteps > 500:
        os.kill(os.getpid(), signal.SIGKILL)
StateCallback._on_rollout_start = new
sys.argv = ["train.py", *{words!r}]
run_command("train")
"""


def test_a_process_that_is_killed(tmp_path, typed):
    """Signals that a process sees are sent to whole commands, see ``tests/commands``."""
    words = ["--env", CART, "--algo", "ppo", "-n", "1200", "--seed", "3", "--eval-episodes", "2"]
    words += ["-params", "n_envs:1", "n_steps:128", "batch_size:64", "n_epochs:1", "--verbose", "0"]
    assert typed("train.py", *words, "-f", "whole")[0] == 0
    script = KILLED.format(words=[*words, "-f", "parts"])
    done = subprocess.run([sys.executable, "-c", script], check=False, timeout=250)
    assert done.returncode == -signal.SIGKILL
    (run,) = (Run(path) for path in tmp_path.glob("parts/ppo/*"))
    assert run.recorded()["state"] == "running"
    assert typed("train.py", "--resume", run.path, "--verbose", "0")[0] == 0
    whole = Run(tmp_path / "whole" / run.path.relative_to(tmp_path / "parts"))
    for each in ("CartPole-v1.zip", "best_model.zip", "evaluations.npz", "0.monitor.csv"):
        assert content(run.path / each) == content(whole.path / each), each
    assert run.recorded()["final"] == whole.recorded()["final"]


def test_a_run_is_cut_off_twice_or_loses_its_state_and_a_state_of_others_is_refused(monkeypatch):
    spec = spec_of(LAKE, "qlearning", 600, {})
    whole, _ = run_of(spec, "whole")
    twice = cut_off(spec, monkeypatch, 0.6, cut_off(spec, monkeypatch, 0.2))
    assert_same(whole, resumed(twice))
    run = cut_off(spec, monkeypatch)
    state = run.state_path.read_bytes()
    for changed in (b"x" * 32 + state[32:], state[:-1], b""):
        run.state_path.write_bytes(changed)
        with pytest.raises(UserError, match="not signed with your key"):
            resumed(run)
    with pytest.raises(UserError, match="is finished already"):
        resumable(whole.path)
    record = json.loads((run.path / "run.json").read_text())
    record["versions"]["torch"] = "1.0"
    (run.path / "run.json").write_text(json.dumps(record))
    with pytest.raises(UserError, match=r"was begun with torch 1\.0, here is "):
        resumable(run.path)
    # Without a state it begins again, in whatever versions.
    run.state_path.unlink()
    assert_same(whole, resumed(run))

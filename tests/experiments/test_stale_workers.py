"""Workers with other code than the driver: they do as the driver would, or do no runs at all.

Workers are processes of their own, with another search path or another folder than the driver.
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path

import pytest
from distributed import LocalCluster

import compare
from experiments.cluster import cluster_launcher
from experiments.cluster.schedulers import SchedulerAddress
from experiments.cluster.sent_code import SentCode
from experiments.launching import execute
from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.errors import UserError
from pipeline.loaded_code import recorded_code
from pipeline.user_modules import UserModule, import_typed

ROOT = Path(compare.__file__).parent
# Five steps: the return is five times the reward, which a module beside it says.
MODULE = """
import gymnasium as gym
from {helper} import REWARD

class Five(gym.Env):
    observation_space = gym.spaces.Discrete(1)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {{}}

    def step(self, action):
        return 0, REWARD, False, False, {{}}

if "{name}-v0" not in gym.registry:
    gym.register("{name}-v0", Five, max_episode_steps=5)
"""


def write_module(folder, name, reward):
    folder.mkdir(parents=True, exist_ok=True)
    helper = f"{name}_reward"
    (folder / f"{name}.py").write_text(MODULE.format(helper=helper, name=name))
    (folder / f"{helper}.py").write_text(f"REWARD = {reward:.1f}\n")


def runs_of(root, modules=(), env_id="FrozenLake-v1", **env_kwargs):
    environments = (EnvironmentSpec("e", env_id, {"n_timesteps": 50, "env_kwargs": env_kwargs}),)
    names = {"gym_packages": tuple(m.name for m in modules), "user_modules": tuple(modules)}
    agents = (AgentSpec("mine", "qlearning", tuned=False),)
    return plan(StudySpec("s", "S", agents, environments, 2, **names), root)


@pytest.fixture
def scheduler():
    with LocalCluster(n_workers=0, dashboard_address=":0", silence_logs=50) as cluster:
        yield cluster


@contextlib.contextmanager
def worker(scheduler, folder, *paths, cwd=None):
    """A worker that searches modules in these folders first; ends with the ``with`` statement."""
    folder.mkdir()
    words = f"-m distributed.cli.dask_worker {scheduler.scheduler_address} --nworkers 1"
    words += f" --nthreads 1 --no-dashboard --local-directory {folder}"
    n_before = len(scheduler.scheduler.workers)
    process = subprocess.Popen(
        [sys.executable, *words.split()],
        cwd=cwd or folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (*paths, ROOT)))},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        until = time.monotonic() + 60
        while len(scheduler.scheduler.workers) == n_before and time.monotonic() < until:
            time.sleep(0.05)
        yield process
    finally:
        process.terminate()
        process.wait(30)


def done(scheduler, root, runs, warm_ups="[]"):
    """The mean returns of the runs, and what was said."""
    said = []
    root.mkdir(parents=True, exist_ok=True)
    there = SchedulerAddress(scheduler.scheduler_address)
    launchers = partial(
        cluster_launcher.cluster_launcher, there, root, "c", warm_ups=warm_ups, tell=said.append
    )
    assert execute(runs, root, launchers, lambda *_: None) == []
    return [run.run.read_info()["final"]["mean_return"] for run in runs], [
        line for line in said if "no runs" in line
    ]


def stale_distribution(folder, name, number):
    """A folder in which a distribution has another version."""
    place = folder / f"{name}-{number}.dist-info"
    place.mkdir(parents=True)
    (place / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {number}\n")
    return folder


def test_unfit_workers_are_set_aside_until_a_fit_one_comes(tmp_path, scheduler, monkeypatch):
    """Where nobody else is left the study ends; those who wait get the worker that comes."""
    stale = stale_distribution(tmp_path / "path", "scipy", "1.16.0")
    other = tmp_path / "other"
    (other / "experiments").mkdir(parents=True)
    (other / "experiments" / "__init__.py").touch()
    (other / "experiments" / "cluster.py").touch()
    root, said = tmp_path / "study", []
    runs = runs_of(root)
    root.mkdir()
    there = SchedulerAddress(scheduler.scheduler_address)
    with (
        worker(scheduler, tmp_path / "w1", stale),
        worker(scheduler, tmp_path / "w2", other, cwd=other),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(cluster_launcher, "SECONDS_WITHOUT_FIT_WORKERS", 2.0)  # two minutes
            with pytest.raises(UserError, match=r"for 2 s no worker "):
                done(scheduler, root, runs)
        launchers = cluster_launcher.cluster_launcher(there, root, "c", tell=said.append)
        with launchers as launcher:
            futures = [launcher.submit(run) for run in runs]
            time.sleep(1)
            assert not any(future.done() for future in futures)
            with worker(scheduler, tmp_path / "w3"):
                assert [future.result(timeout=60) for future in futures] == [None, None]
    said = [line for line in said if "no runs" in line]
    assert len(said) == 2
    told = f" on {os.uname().nodename}: scipy 1.16.0 instead of {version('scipy')}"
    assert any(told in line for line in said)
    assert any("experiments.cluster" in line for line in said)


def test_an_installed_module_of_other_contents_is_not_used(tmp_path, scheduler, monkeypatch):
    for name, reward in (("mine", 1), ("theirs", 7)):
        write_module(tmp_path / name, "five_found", reward)
    monkeypatch.syspath_prepend(tmp_path / "mine")
    modules = import_typed(["five_found"])
    assert modules == (UserModule("five_found", "five_found"),)
    runs = runs_of(tmp_path / "study", modules, "five_found-v0")
    with (
        worker(scheduler, tmp_path / "w1", tmp_path / "theirs"),
        worker(scheduler, tmp_path / "w2", tmp_path / "mine"),
    ):
        found, said = done(scheduler, tmp_path / "study", runs)
    assert found == [5.0, 5.0]
    assert len(said) <= 1  # it may have had no order
    assert all("the module five_found has other contents" in line for line in said)


def test_runs_load_what_was_sent_whatever_lies_there_or_was_imported(
    tmp_path, scheduler, monkeypatch
):
    modules, recorded = {}, {}
    for name, reward in (("old", 7), ("new", 1)):  # each as a driver of its own
        write_module(tmp_path / name, "five_sent", reward)
        monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
        for imported in ("five_sent", "five_sent_reward"):
            monkeypatch.delitem(sys.modules, imported, raising=False)
        modules[name] = import_typed([str(tmp_path / name / "five_sent.py")])
        recorded[name] = recorded_code(modules[name])
        (run, _) = runs_of(tmp_path, modules[name], "five_sent-v0")
        assert SentCode.of(run.spec).modules[0].digests  # as at the beginning of a study
        monkeypatch.undo()
    # Then somebody changes one, and the worker finds others by itself.
    write_module(tmp_path / "new", "five_sent", 9)
    write_module(tmp_path / "path", "five_sent", 9)
    item = {
        "algo": "qlearning",
        "env_id": "five_sent-v0",
        "hyperparams": run.spec.saved_hyperparams,
    }
    warm_ups = json.dumps([{**item, "modules": [asdict(modules["old"][0])]}])
    with worker(scheduler, tmp_path / "w", tmp_path / "path"):
        for name, reward in (("old", 7.0), ("new", 1.0)):
            root = tmp_path / "studies" / name
            runs = runs_of(root, modules[name], "five_sent-v0")
            assert done(scheduler, root, runs, warm_ups) == ([5 * reward] * 2, [])
            warm_ups = "[]"
            for run in runs:
                info = run.run.read_info()
                assert {key: info[key] for key in recorded[name]} == recorded[name]
                copy = (run.path / "modules" / "five_sent_reward.py").read_text()
                assert copy == f"REWARD = {reward:.1f}\n"

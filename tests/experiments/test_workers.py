"""Workers in processes of their own: whatever dies, runs end as here; with other code they do none.

Two clusters in all, since each worker that starts takes seconds.
"""

import contextlib
import json
import os
import runpy
import socket
import ssl
import subprocess
import sys
import time
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path

import psutil
import pytest
from distributed import LocalCluster
from rl_yardstick.experiments.cluster.schedulers import LocalWorkers, SchedulerAddress
from rl_yardstick.experiments.cluster.sent_code import SentCode
from rl_yardstick.experiments.cluster.working import Probe
from rl_yardstick.experiments.launching import execute
from rl_yardstick.experiments.run_folders import draft_path
from rl_yardstick.experiments.run_in_child import do_run
from rl_yardstick.pipeline.loaded_code import recorded_code
from rl_yardstick.pipeline.user_modules import import_typed

import compare
from rl_yardstick.experiments.cluster import cluster_launcher
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.errors import UserError

ROOT = Path(compare.__file__).parent


def runs_of(root, modules=(), environments=None):
    """Two runs on each environment, given by its label as identifier and arguments."""
    environments = environments or {"lake": ("FrozenLake-v1", {})}
    places = [
        EnvironmentSpec(label, env_id, {"n_timesteps": 50, "env_kwargs": arguments})
        for label, (env_id, arguments) in environments.items()
    ]
    agents = (AgentSpec("mine", "qlearning", tuned=False),)
    names = {"gym_packages": tuple(m.name for m in modules), "user_modules": tuple(modules)}
    return plan(StudySpec("s", "S", agents, tuple(places), 2, **names), root)


def listening():
    """The ports that this process and those that it has started listen to, with whose they are."""
    here = psutil.Process()
    return {
        each.laddr.port: process.pid
        for process in (here, *here.children(recursive=True))
        for each in process.net_connections("tcp")
        if each.status == psutil.CONN_LISTEN
    }


def answer_of(port, context=None):
    """What a port says to somebody who has no certificate; nothing if it closes."""
    try:
        with contextlib.ExitStack() as stack:
            asker = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
            if context is not None:
                asker = stack.enter_context(context.wrap_socket(asker))
            asker.sendall(b"GET /json/identity.json HTTP/1.0\r\n\r\n")
            return asker.recv(100)
    except (ConnectionError, ssl.SSLError):
        return b""


DEADLY = """
import multiprocessing, os, pathlib, signal, time
import gymnasium as gym
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv

class Deadly(FrozenLakeEnv):
    def __init__(self, marks, **kwargs):
        super().__init__(**kwargs)
        self.marks = pathlib.Path(marks)

    def reset(self, **kwargs):
        parent, n_marks = multiprocessing.parent_process(), len(list(self.marks.iterdir()))
        if parent is not None and self.marks.name == "poison":
            os.kill(os.getpid(), signal.SIGKILL)
        if parent is not None and n_marks < 2:
            (self.marks / str(n_marks)).touch()
            os.kill(parent.pid, signal.SIGTERM if n_marks else signal.SIGKILL)
            time.sleep(60)
        return super().reset(**kwargs)

gym.register("Deadly-v0", Deadly, max_episode_steps=20)
"""


def test_a_cluster_does_what_this_machine_does_whatever_dies(tmp_path, monkeypatch):
    """By a worker with no folder in common, as on other machines: files come back."""
    contents = runpy.run_path(str(ROOT / "benchmarks/_run_contents.py"))["contents"]
    for run in runs_of(tmp_path / "here"):
        do_run(run, draft_path(tmp_path / "here", run), "c")
    here = contents(tmp_path / "here" / "runs")
    assert here
    (tmp_path / "deadly_lake.py").write_text(DEADLY)
    modules = import_typed([str(tmp_path / "deadly_lake.py")])
    places = {"lake": ("FrozenLake-v1", {})}
    for name in ("killing", "poison"):
        (tmp_path / name).mkdir()
        places[name] = ("Deadly-v0", {"marks": str(tmp_path / name)})
    root = tmp_path / "there"
    root.mkdir()
    # Both on the lake, and one of each environment that kills.
    runs = [
        run for run in runs_of(root, modules, places) if run.environment == "lake" or run.seed == 0
    ]

    @contextlib.contextmanager
    def elsewhere(root):
        yield Probe(Path("/nowhere"), root, ".probe", "x")

    monkeypatch.setattr(cluster_launcher, "probing", elsewhere)
    monkeypatch.setattr(cluster_launcher, "MOST_TRIES", 2)  # three: a worker takes long to start
    before = listening()  # of servers that other tests have left
    with cluster_launcher.cluster_launcher(LocalWorkers(1), root, "c") as launcher:
        failures = execute(runs, root, lambda: contextlib.nullcontext(launcher), lambda *_: None)
        # Nobody without a certificate gets an answer, with TLS or without.
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        ports = listening().keys() - before.keys()
        assert len(ports) >= 3  # of the scheduler, the worker, and what starts it
        assert {answer_of(port, given) for port in ports for given in (None, context)} == {b""}
    assert sorted(path.name for path in root.iterdir()) == ["failures", "runs"]
    # A run whose worker is killed is tried again, and one whose worker is asked to end, as by a
    # queue, is not blamed for it; one that dies each time fails alone.
    assert len(list((tmp_path / "killing").iterdir())) == 2
    (failure,) = failures
    assert failure.planned.environment == "poison"
    assert failure.reason == "its process died 2 times (SIGKILL)"
    found = contents(root / "runs")
    # Beside the module's copies and digests.
    digests = [found[name].pop("module_digests") for name in found if "run.json" in name]
    assert [digest.keys() for digest in digests] == [{"deadly_lake.py"}] * 3
    assert {name: found.get(name) for name in here} == here


# --- Workers with another search path than the driver's.

# Five steps: the return is five times the reward, which a module beside it says.
MODULE = """
import gymnasium as gym
import iniconfig  # a distribution that is there, and that the project itself does not import
from five_reward import REWARD

class Five(gym.Env):
    observation_space = gym.spaces.Discrete(1)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, REWARD, False, False, {}

if "Five-v0" not in gym.registry:
    gym.register("Five-v0", Five, max_episode_steps=5)
"""


def write_module(folder, reward):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "five.py").write_text(MODULE)
    (folder / "five_reward.py").write_text(f"REWARD = {reward:.1f}\n")


@contextlib.contextmanager
def worker(scheduler, folder, path):
    """A worker that searches modules in a folder first; ends with the ``with`` statement."""
    folder.mkdir()
    words = f"-m distributed.cli.dask_worker {scheduler.scheduler_address} --nworkers 1"
    words += f" --nthreads 1 --no-dashboard --local-directory {folder}"
    n_before = len(scheduler.scheduler.workers)
    process = subprocess.Popen(
        [sys.executable, *words.split()],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{path}{os.pathsep}{ROOT}"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        until = time.monotonic() + 120
        while len(scheduler.scheduler.workers) == n_before and time.monotonic() < until:
            time.sleep(0.05)
        yield
    finally:
        process.terminate()
        process.wait(60)


@pytest.fixture
def drivers(tmp_path, monkeypatch):
    """Runs on two modules of one name, as two commands ask for them, and what each has loaded."""
    asked = {}
    for name, reward in (("old", 7), ("new", 1)):
        write_module(tmp_path / name, reward)
        with monkeypatch.context() as patch:
            patch.setattr(sys, "meta_path", list(sys.meta_path))
            for imported in ("five", "five_reward"):
                patch.delitem(sys.modules, imported, raising=False)
            modules = import_typed([str(tmp_path / name / "five.py")])
            (tmp_path / "studies" / name).mkdir(parents=True)
            runs = runs_of(tmp_path / "studies" / name, modules, {"five": ("Five-v0", {})})
            assert SentCode.of(runs[0].spec).modules[0].digests  # as at the beginning of a study
            asked[name] = (runs, recorded_code(modules))
    return asked


def check_done(runs, recorded, reward):
    for run in runs:
        info = run.run.read_info()
        assert info["final"]["mean_return"] == 5 * reward
        assert {key: info[key] for key in recorded} == recorded
        copy = (run.path / "modules" / "five_reward.py").read_text()
        assert copy == f"REWARD = {reward:.1f}\n"


def test_fit_workers_load_what_was_sent_and_others_are_set_aside(tmp_path, drivers, monkeypatch):
    """Where nobody fit is left the study ends; those who wait get the worker that comes."""
    stale = tmp_path / "stale" / "iniconfig-1.0.dist-info"
    stale.mkdir(parents=True)
    (stale / "METADATA").write_text("Metadata-Version: 2.1\nName: iniconfig\nVersion: 1.0\n")
    # Somebody changes a module since, and the fit worker finds others by itself.
    write_module(tmp_path / "new", 9)
    write_module(tmp_path / "path", 9)
    runs, recorded = drivers["old"]
    item = {"algo": "qlearning", "env_id": "Five-v0", "hyperparams": runs[0].spec.saved_hyperparams}
    warm_ups = json.dumps([{**item, "modules": [*map(asdict, runs[0].spec.user_modules)]}])
    said = []
    with LocalCluster(n_workers=0, dashboard_address=":0", silence_logs=50) as scheduler:
        where = SchedulerAddress(scheduler.scheduler_address)
        launchers = {
            name: partial(
                cluster_launcher.cluster_launcher,
                where,
                tmp_path / "studies" / name,
                "c",
                warm_ups=warm_ups if name == "old" else "[]",
                tell=said.append,
            )
            for name in drivers
        }
        with worker(scheduler, tmp_path / "w1", stale.parent):
            with monkeypatch.context() as patch:
                patch.setattr(cluster_launcher, "SECONDS_WITHOUT_FIT_WORKERS", 1.0)  # two minutes
                with pytest.raises(UserError, match=r"for 1 s no worker "):
                    execute(runs, tmp_path / "studies" / "old", launchers["old"], lambda *_: None)
            with launchers["old"]() as launcher:
                futures = [launcher.submit(run) for run in runs]
                with worker(scheduler, tmp_path / "w2", tmp_path / "path"):
                    assert [future.result(timeout=200) for future in futures] == [None, None]
                    check_done(runs, recorded, 7)
                    # The next command finds the workers as they are.
                    runs, recorded = drivers["new"]
                    root = tmp_path / "studies" / "new"
                    assert execute(runs, root, launchers["new"], lambda *_: None) == []
                    check_done(runs, recorded, 1)
    told = f" on {os.uname().nodename}: iniconfig 1.0 instead of {version('iniconfig')}"
    assert any("no runs" in line and told in line for line in said)

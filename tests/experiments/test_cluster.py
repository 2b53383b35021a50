"""Runs on Dask's workers, which share the folder: a worker that is lost, others that do not fit."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from rich.console import Console

pytest.importorskip("dask_jobqueue")

from rl_yardstick.experiments import cluster
from rl_yardstick.experiments.cluster import ClusterWorkers
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.pool import do_runs
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.run import Stop

CONSOLE = Console(quiet=True)


def planned(root, n_seeds, **settings):
    place = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 20_000, **settings})
    agents = (AgentSpec("sarsa", "sarsa", {"engine": "interpreted"}),)
    return plan(StudySpec("s", "S", agents, (place,), n_seeds), root)


def test_runs_of_a_worker_that_is_killed_are_done_again(tmp_path):
    runs = planned(tmp_path, 1)
    root = tmp_path.absolute()
    with ClusterWorkers("local:1", 0, root) as workers:

        def kill():
            while not list(root.glob("runs/*/*/0.monitor.csv")):
                time.sleep(0.05)
            (pid,) = workers._client.run(os.getpid).values()
            os.kill(pid, signal.SIGKILL)

        thread = threading.Thread(target=kill)
        thread.start()
        assert do_runs(runs, workers, "compare.py", CONSOLE, Stop()) == {}
        thread.join()
    assert all(run.is_finished for run in runs)


def test_a_run_that_fails_or_takes_too_long_is_not_repeated(tmp_path):
    runs = planned(tmp_path, 1, n_timesteps=10**7)
    with ClusterWorkers("local:1", 0, tmp_path, timeout=2.0) as workers:
        (reason,) = do_runs(runs, workers, "compare.py", CONSOLE, Stop()).values()
    assert reason == "took longer than --run-timeout allows, 2 s"


@pytest.mark.parametrize(
    ("facts", "complaint"),
    [
        (lambda root: ({"python": "2.7"}, True), "has python 2.7, here is"),
        (lambda root: (cluster.versions(), False), "does not have the folder"),
    ],
)
def test_workers_that_do_not_fit_are_refused(tmp_path, monkeypatch, facts, complaint):
    monkeypatch.setattr(cluster, "_facts", facts)
    refused = pytest.raises(UserError, match=complaint)
    with ClusterWorkers("local:1", 0, tmp_path) as workers, refused:
        workers.submit(planned(tmp_path, 1)[0], "")


QUEUE = "jobqueue: {slurm: {cores: 1, memory: 1GB}}\n"


@pytest.mark.parametrize(
    ("where", "n_jobs", "complaint"),
    [
        ("local:none", 0, "give ADDRESS:PORT, a scheduler's file"),
        ("local:2", 3, "--jobs is for this machine or a queue of jobs"),
        (QUEUE, 0, "say how many runs to do at once: --jobs N"),
        ("jobqueue: {slrum: {}}\n", 2, "'slrum' is none of htcondor"),
        ("slurm: {}\n", 2, "must hold the key jobqueue"),
    ],
)
def test_a_cluster_that_cannot_be(where, n_jobs, complaint, tmp_path):
    if "\n" in where:
        (tmp_path / "queue.yml").write_text(where)
        where = str(tmp_path / "queue.yml")
    with pytest.raises(UserError, match=complaint):
        ClusterWorkers(where, n_jobs, tmp_path).submit(planned(tmp_path, 1)[0], "")


def test_a_queue_starts_jobs(tmp_path, monkeypatch):
    """With the settings of the file, and the library's defaults for the rest."""
    import dask

    asked = []

    class Cluster:
        def scale(self, n):
            asked.append((n, dask.config.get("jobqueue.slurm")))

    monkeypatch.setattr(cluster.dask_jobqueue, "SLURMCluster", Cluster)
    (tmp_path / "queue.yml").write_text(QUEUE.replace("1GB", "1GB, walltime: '1:00', job_cpu: 3"))
    cluster._job_queue(Path(tmp_path / "queue.yml"), 4)
    ((n_jobs, settings),) = asked
    assert (n_jobs, settings["walltime"], settings["job-cpu"]) == (4, "1:00", 3)
    assert settings["death-timeout"] == 60

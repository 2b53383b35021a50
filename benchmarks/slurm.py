"""A study by the real SLURM on this machine, with jobs cancelled, preempted and killed.

    apt-get install slurm-wlm munge                      # Debian: 17 s
    python benchmarks/slurm.py --runs 8 --faults scancel preempt      # a look, a minute or two
    python benchmarks/slurm.py                                        # docs/run-folder.md

The program starts munge, slurmctld and two slurmd in a temporary folder, and stops them at its end.
The study's jobs are those of docs/cluster.md, but smaller. Faults come one by one while runs are
done. In the end every file must be the same as in an undisturbed study on this machine, with no
keys left, and no job output in the working directory. Otherwise the exit code is 1.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from _campaigns import contents, send

ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scancel", "scontrol", "squeue")
FAULTS = ["scancel", "preempt", "worker", "requeue", "scancel"]
FAULTS += ["node", "preempt", "controller", "driver", "scancel"]
STUDY = "--env FrozenLake-v1 --algos qlearning sarsa -n 2000"
MOST_SECONDS = 1800.0
CONFIGURATION = """
ClusterName=yardstick
SlurmctldHost={host}
SlurmctldPort={ports[0]}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
SlurmUser={user}
SlurmdUser={user}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
SlurmdTimeout=20
KillWait=10
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=2 RealMemory=4000
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=2 RealMemory=4000
PartitionName=normal Nodes=n[1-2] Default=YES PriorityTier=1 State=UP
PartitionName=urgent Nodes=n[1-2] PriorityTier=2 PreemptMode=OFF State=UP
"""


class Slurm:
    """A controller and two nodes with two slots each, in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {
            **os.environ,
            "SLURM_CONF": str(folder / "slurm.conf"),
            "OMP_NUM_THREADS": "1",
            "PYTHONPATH": str(ROOT),
        }
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.commands = {
            "munge": f"munged --foreground --force --socket {folder}/munge.socket --key-file "
            f"{folder}/key --pid-file {folder}/munge.pid --log-file {folder}/munge.log "
            f"--seed-file {folder}/seed",
            "controller": "slurmctld -D",
            "n1": "slurmd -D -N n1",
            "n2": "slurmd -D -N n2",
        }

    def configure(self) -> None:
        """Write the configuration, and the key of munge."""
        with contextlib.ExitStack() as stack:
            sockets = [stack.enter_context(socket.socket()) for _ in range(3)]
            for each in sockets:
                each.bind(("127.0.0.1", 0))
            ports = [each.getsockname()[1] for each in sockets]
        for name in ("state", "spool-n1", "spool-n2"):
            (self.folder / name).mkdir()
        (self.folder / "key").write_bytes(secrets.token_bytes(1024))
        (self.folder / "key").chmod(0o400)
        names = {"host": socket.gethostname(), "user": os.environ.get("USER") or "root"}
        text = CONFIGURATION.format(folder=self.folder, ports=ports, **names)
        (self.folder / "slurm.conf").write_text(text, encoding="utf-8")

    def start(self, name: str) -> None:
        """Start one of the daemons."""
        program, *words = self.commands[name].split()
        with (self.folder / f"{name}.output").open("ab") as output:
            self.running[name] = subprocess.Popen(
                [shutil.which(program) or program, *words],
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )

    def kill(self, name: str) -> None:
        """Kill a daemon, and for a node all of its jobs; start it again after two seconds."""
        self.running[name].kill()
        self.running[name].wait()
        for job in self.jobs(name) if name in ("n1", "n2") else []:
            for pid in pids_of(job):
                send(pid, signal.SIGKILL)
        time.sleep(2)
        self.start(name)

    def said(self, *words: str) -> str:
        """The output of a SLURM command, also if it fails."""
        done = subprocess.run(
            words, env=self.environment, capture_output=True, text=True, check=False, timeout=60
        )
        return done.stdout + done.stderr

    def jobs(self, node: str = "") -> list[str]:
        """The numbers of the study's running jobs."""
        words = ["-h", "-t", "R", "-p", "normal", "-o", "%i", *(["-w", node] * bool(node))]
        return [line for line in self.said("squeue", *words).split() if line.isdecimal()]

    def wait(self) -> None:
        """Wait until both nodes accept jobs; SystemExit after a minute."""
        until = time.monotonic() + 60
        while self.said("sinfo", "-h", "-t", "idle", "-o", "%D", "-p", "normal").strip() != "2":
            if time.monotonic() > until:
                raise SystemExit(f"SLURM does not start: {self.said('sinfo')}")
            time.sleep(0.5)


@contextlib.contextmanager
def slurm(folder: Path) -> Iterator[Slurm]:
    """SLURM during the ``with`` statement."""
    cluster = Slurm(folder)
    cluster.configure()
    try:
        for name in cluster.commands:
            cluster.start(name)
            time.sleep(1)
        cluster.wait()
        yield cluster
    finally:
        with contextlib.suppress(Exception):
            cluster.said("scancel", "--signal=KILL", "--full", "-u", os.environ.get("USER", "root"))
        for process in reversed(cluster.running.values()):
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(20)
            process.kill()


def pids_of(job: str, kind: str = "") -> list[int]:
    """The processes of a job; with "spawn_main", only its workers."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            environment = (folder / "environ").read_bytes().split(b"\0")
            is_of_job = f"SLURM_JOB_ID={job}".encode() in environment
            if is_of_job and kind.encode() in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
    return sorted(found)


def documented_jobs(folder: Path) -> None:
    """Write the ``slurm.yml`` of docs/cluster.md for these nodes."""
    page = (ROOT / "docs/cluster.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(jobqueue:.*?)```", page, re.DOTALL)
    settings: dict[str, Any] = yaml.safe_load(block)
    settings["jobqueue"]["slurm"] |= {
        "cores": 2,
        "memory": "1GB",
        "walltime": "90:00",
        "interface": "lo",
        "shared-temp-directory": str(folder / "keys"),
        "local-directory": str(folder / "local"),
        "python": sys.executable,
        "death-timeout": 20,
        "job-script-prologue": [],
    }
    (folder / "keys").mkdir(exist_ok=True)
    (folder / "slurm.yml").write_text(yaml.safe_dump(settings), encoding="utf-8")


class Study:
    """A command that does a study by SLURM, in a working directory."""

    def __init__(self, cluster: Slurm, folder: Path, words: str) -> None:
        self.cluster, self.folder, self.words = cluster, folder, words
        self.name = words.rsplit(maxsplit=1)[-1]
        self.process = self._started()

    def _started(self) -> subprocess.Popen[bytes]:
        path = self.folder / "slurm.yml"
        words = [*self.words.split(), "-f", "slurm", "--cluster", str(path), "--jobs", "4"]
        with (self.folder / f"{self.name}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, str(ROOT / "compare.py"), *words],
                cwd=self.folder,
                env=self.cluster.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    @property
    def n_done(self) -> int:
        """The number of finished runs."""
        return sum(1 for _ in self.folder.glob(f"slurm/{self.name}/runs/*/*/run.json"))

    def suffer(self, fault: str) -> str:
        """Inject a fault; return what happened."""
        cluster = self.cluster
        if fault == "driver":
            self.process.kill()
            self.process.wait()
            self.process = self._started()
            return "killed, and given again"
        if fault in ("controller", "node"):
            name = "controller" if fault == "controller" else "n1"
            cluster.kill(name)
            return f"{name} killed, and started again"
        until = time.monotonic() + 90
        while not cluster.jobs() and time.monotonic() < until:
            time.sleep(0.5)
        job = next(iter(cluster.jobs()), "")
        if fault == "worker":
            for pid in pids_of(job, "spawn_main")[:1]:
                send(pid, signal.SIGKILL)
            return f"of job {job}"
        if fault == "preempt":
            urgent = ["-p", "urgent", "-N", "1", "--exclusive", "--no-requeue", "-o", "/dev/null"]
            return cluster.said("sbatch", *urgent, "--wrap", "sleep 3").strip()
        words = ("scontrol", "requeue", job) if fault == "requeue" else ("scancel", job)
        return f"job {job} {cluster.said(*words).strip()}"


def disturbed(study: Study, faults: Sequence[tuple[int, str]]) -> None:
    """Wait for the end of a study, with faults after given numbers of finished runs."""
    left, until = list(faults), time.monotonic() + MOST_SECONDS
    while study.process.poll() is None and time.monotonic() < until:
        time.sleep(0.1)
        if left and study.n_done >= left[0][0]:
            count, fault = left.pop(0)
            print(f"{count:5d} runs: {fault}: {study.suffer(fault)}", flush=True)
    if left:
        print(f"came too late: {left}")


def told(study: Study, folder: Path, n_runs: int) -> bool:
    """Print the result of a study and its differences; return whether all is correct."""
    where = folder / "slurm" / study.name
    for job_logs in where.glob("jobs"):
        shutil.move(job_logs, folder / f"{study.name}-jobs")
    whole, found = contents(folder / "here" / study.name), contents(where)
    differing = [k for k in whole.keys() | found.keys() if whole.get(k) != found.get(k)]
    said = (folder / f"{study.name}.log").read_text(encoding="utf-8", errors="replace")
    strays = [*folder.glob("*.out"), *folder.glob("keys/.*"), *folder.glob("*.err")]
    code = study.process.poll()
    print(
        f"{study.name}: exit code {code}, {study.n_done} of {n_runs} runs, {len(whole)} files "
        f"compared, differing {sorted(differing)[:5]}, tracebacks {said.count('Traceback')}, "
        f"left {[path.name for path in strays]}",
        flush=True,
    )
    is_whole = code == 0 and study.n_done == n_runs and whole and not (differing or strays)
    return bool(is_whole) and "Traceback" not in said


def campaign(folder: Path, args: argparse.Namespace) -> bool:
    """Do the study, by SLURM and locally; return whether all is correct."""
    n_seeds = max(args.runs // 2, 1)
    words = f"{STUDY} --seeds {n_seeds} --no-report --name short"
    here = [sys.executable, str(ROOT / "compare.py"), *words.split(), "-f", "here", "-j", "2"]
    places = [round((n + 0.5) * 1.6 * n_seeds / len(args.faults)) for n in range(len(args.faults))]
    with slurm(folder) as cluster:
        documented_jobs(folder)
        begun = time.monotonic()
        subprocess.run(
            here, cwd=folder, env=cluster.environment, check=True, stdout=subprocess.DEVNULL
        )
        middle = time.monotonic()
        study = Study(cluster, folder, words)
        try:
            disturbed(study, [*zip(places, args.faults, strict=True)])
        finally:
            study.process.kill()
        is_whole = told(study, folder, 2 * n_seeds)
        print(f"here {middle - begun:.0f} s, by SLURM {time.monotonic() - middle:.0f} s")
    return is_whole


def main() -> int:
    """Do the campaign; return 1 if something differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--faults", nargs="*", default=FAULTS, choices=sorted({*FAULTS}))
    args = parser.parse_args()
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    if missing:
        raise SystemExit(f"{', '.join(missing)} missing: apt-get install slurm-wlm munge")
    folder = Path(tempfile.mkdtemp(prefix="slurm-campaign-"))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # ends the daemons
    is_whole = campaign(folder, args)
    if is_whole:
        shutil.rmtree(folder, ignore_errors=True)
    else:
        print(f"see {folder}")
    return 0 if is_whole else 1


if __name__ == "__main__":
    sys.exit(main())

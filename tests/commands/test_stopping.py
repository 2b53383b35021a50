"""What ends a command from outside: signals, kills, environments that exit, folders that go."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

from agents import load_algorithm

ROOT = Path(__file__).parents[2]


# --- signals at named moments of a training: what is left, and how the process ends ---------------

WORDS = ["--algo", "qlearning", "--env", "FrozenLake-v1", "-n", "600", "--seed", "0"]
# At most two seconds on a machine that has nothing else to do.
SECONDS = 10


@pytest.fixture(scope="module")
def server():
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("stopping_server.py"))],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        yield process


@pytest.fixture
def stopped(server, tmp_path):
    """Do a command, with signals by moment; the exit code."""

    def run(*words, ignored=(), **plan):
        plan = {moment.replace("_", " "): names.split() for moment, names in plan.items()}
        request = {"folder": str(tmp_path), "words": words, "plan": plan, "ignored": ignored}
        server.stdin.write(json.dumps(request) + "\n")
        server.stdin.flush()
        answer = json.loads(server.stdout.readline())
        (tmp_path / "signalled").unlink()
        assert answer["seconds"] < SECONDS
        return answer["code"]

    return run


@pytest.fixture
def train_stopped(stopped, tmp_path):
    """Train, with signals by moment; exit code, the run's record or None, and the run folder."""

    def run(*words, engine="interpreted", **options):
        code = stopped("train.py", *WORDS, *words, "-params", f"engine:{engine}", **options)
        folder = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
        record = json.loads((folder / "run.json").read_text()) if folder.exists() else None
        for path in folder.rglob("*.zip"):
            with zipfile.ZipFile(path) as archive:
                assert archive.testzip() is None
        return code, record, folder

    return run


def holds(folder):
    return sorted(p.name for p in folder.iterdir() if p.suffix in (".zip", ".png", ".tmp"))


# Signals by moment; how the process ends, and the state of the run, if one has begun.
MOMENTS = [
    ({"set-up": "SIGINT"}, 130, None),
    ({"between": "SIGTERM"}, 143, None),
    ({"before the first step": "SIGINT"}, 130, None),
    ({"compiling": "SIGINT"}, 130, "interrupted"),
    ({"training": "SIGTERM"}, 143, "interrupted"),
    ({"training": "SIGHUP"}, 129, "interrupted"),
    ({"evaluating": "SIGINT"}, 130, "interrupted"),
    ({"saving": "SIGHUP"}, 129, "interrupted"),
    ({"judging": "SIGTERM"}, 143, "interrupted"),
    ({"drawing": "SIGINT"}, 130, "interrupted"),
    ({"recording": "SIGTERM"}, 0, "finished"),
    ({"closing": "SIGTERM"}, 0, "finished"),
    # The second leaves out what can be.
    ({"training": "SIGINT SIGTERM"}, 130, "interrupted"),
    ({"training": "SIGINT", "saving": "SIGTERM"}, 130, "interrupted"),
    ({"training": "SIGINT", "drawing": "SIGTERM"}, 130, "interrupted"),
    ({"saving": "SIGINT SIGINT SIGTERM"}, -signal.SIGTERM, "running"),  # the third ends it at once
]


@pytest.mark.parametrize(
    ("plan", "code", "state"),
    MOMENTS,
    ids=[", ".join(f"{moment}: {names}" for moment, names in plan.items()) for plan, *_ in MOMENTS],
)
def test_how_a_training_ends_by_signals(train_stopped, tmp_path, plan, code, state):
    moment, *others = plan
    first, *more = plan[moment].split()
    engine = "compiled" if moment == "compiling" else "interpreted"
    if moment == "compiling":  # before, so that it takes less than the patience for a signal
        load_algorithm("qlearning")("QTablePolicy", "FrozenLake-v1", engine=engine).learn(10)
    found, record, folder = train_stopped(engine=engine, **plan)
    assert (found, record and record["state"]) == (code, state)
    if state is None:
        assert not (tmp_path / "logs").exists()
        how = "interrupted" if code == 130 else f"ended by {first}"
        assert (tmp_path / "err").read_text() == f"train.py: {how}\n"
    elif state == "running":
        (draft,) = [name for name in holds(folder) if name.endswith(".tmp")]
        assert draft.startswith(".FrozenLake-v1.zip.")
        # The next command clears up.
        (folder / "notes.tmp").touch()
        assert train_stopped("--eval-freq", "-1", drawing="SIGINT")[0] == 130
        assert holds(folder) == ["best_model.zip", "notes.tmp"]
    elif state == "interrupted":
        # What was learnt is saved.
        assert (record["stopped_by"], "process" in record) == (first, False)
        assert "FrozenLake-v1.zip" in record["files"]
        is_trained = moment in ("saving", "judging", "drawing")
        assert (record["n_timesteps"] == 600) is is_trained
        if more or others:
            best = ["best_model.zip"] if others == ["drawing"] else []
            assert holds(folder) == ["FrozenLake-v1.zip", *best]
        else:
            assert (record["final"] is not None) is (moment == "drawing")
            assert [name for name in holds(folder) if name.endswith(".tmp")] == []


def test_what_is_ignored_from_outside_stays_ignored(train_stopped):
    code, record, _ = train_stopped(ignored=["SIGHUP", "SIGINT"], training="SIGHUP SIGINT SIGHUP")
    assert (code, record["state"]) == (0, "finished")
    # As in the background.
    code, record, _ = train_stopped(ignored=["SIGINT"], training="SIGINT SIGTERM")
    assert code == 143


def test_a_comparison_by_a_log_ends_as_every_command(stopped, tmp_path):
    (tmp_path / "log.csv").write_text("arm,reward,propensity\n0,1,0.5\n")
    words = ("compare.py", "--logged", "log.csv", "--policy", "run")
    assert stopped(*words, **{"reading a log": "SIGTERM"}) == 143
    assert (tmp_path / "err").read_text() == "compare.py: ended by SIGTERM\n"


# --- a sample of the campaigns of kills: nothing differs, and nothing is left -------------------


def test_killed_commands_end_as_they_would_have(tmp_path):
    script = ROOT / "benchmarks" / "fault_campaign.py"
    # Networks take several times as long.
    words = ["--kills", "1", "--jobs", "1", "--only", "qlearning on Warehouse-v0"]
    paths = os.pathsep.join([str(ROOT), str(script.parent)])
    result = subprocess.run(
        [sys.executable, str(script), *words],
        env={**os.environ, "PYTHONPATH": paths, "TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    *_, total, _ = result.stdout.splitlines()
    cells = [cell.strip() for cell in total.split("│")[1:-1]]
    assert cells[0] == "all"
    assert int(cells[2]) >= 1  # signals that were sent
    assert int(cells[7]) >= 1  # commands that came to their end
    assert cells[8:] == ["0"] * 6


# --- what an environment raises to end the program is its run's failure ------------------------

LEAVING = """
import gymnasium as gym

import builtins


class Leaving(gym.Env):
    observation_space = gym.spaces.Discrete(4)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, where="step", kind="SystemExit", words=None, after=1, render_mode=None):
        self.where, self.after, self.words, self.calls = where, after, words, 0
        self.kind = getattr(builtins, kind)

    def leave(self, where):
        self.calls += where == self.where
        if where == self.where and self.calls > self.after:
            raise self.kind() if self.words is None else self.kind(self.words)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.leave("reset")
        return 0, {}

    def step(self, action):
        self.leave("step")
        return int(self.np_random.integers(4)), 1.0, bool(self.np_random.random() < 0.2), False, {}

    def close(self):
        self.leave("close")


gym.register("Leaving-v0", Leaving, max_episode_steps=10)
"""


@pytest.fixture
def train_leaving(type_in_own_folder, own_folder, monkeypatch):
    """Train on an environment that leaves; code, what is said, and the record if there is one."""
    (own_folder / "leaving.py").write_text(LEAVING)

    def train(*kwargs, algo="qlearning"):
        code, _, said = type_in_own_folder(
            *("train.py", "--env", "Leaving-v0", "--algo", algo, "-n", "300", "--verbose", "0"),
            *("--gym-packages", "leaving.py", "--eval-freq", "100", "--env-kwargs", *kwargs),
        )
        record = own_folder / "logs" / algo / "Leaving-v0_1" / "run.json"
        return code, said, json.loads(record.read_text()) if record.exists() else None

    return train


AT_RESET, AT_STEP = "where:'reset' after:20", "where:'step' after:0"


@pytest.mark.parametrize(
    ("kind", "words", "moment"),
    [
        ("SystemExit", "0", AT_STEP),
        ("SystemExit", "'text'", AT_RESET),
        ("KeyboardInterrupt", "", AT_STEP),
    ],
)
def test_a_run_has_failed_and_says_where(train_leaving, kind, words, moment):
    more = [f"words:{words}"] if words else []
    code, said, record = train_leaving(*moment.split(), f"kind:'{kind}'", *more)
    text = f"{kind}: {words}".replace("'", "").removesuffix(": ")
    assert (code, said.count("\n")) == (2, 1)
    assert f"leaving.py:18: {text}, which ends no command" in said
    assert record["state"] == "failed"
    assert text in record["reason"]


# --- somebody removes the folder that a command works on ------------------------------------------

REMOVING = """
import pathlib
import shutil

import gymnasium as gym


class Removing(gym.Env):
    observation_space = gym.spaces.Discrete(4)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, folder, by="removing", render_mode=None):
        self.folder, self.by, self.steps = pathlib.Path(folder), by, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        self.steps += 1
        if self.steps == 500 and self.folder.exists():
            self.folder.rename(f"{self.folder}-elsewhere")
            if self.by == "removing":
                shutil.rmtree(f"{self.folder}-elsewhere")
        return int(self.np_random.integers(4)), 1.0, bool(self.np_random.random() < 0.2), False, {}


gym.register("Removing-v0", Removing, max_episode_steps=10)
"""
TRAINING = ["train.py", "--algo", "qlearning", "-n", "100000000", "-f", "logs"]
TUNE = [
    "tune.py",
    "--algo",
    "qlearning",
    "-n",
    "100000000",
    "--trials",
    "2",
    "-j",
    "2",
    "-f",
    "logs",
]
COMPARE = ["compare.py", "study.yml", "--no-report", "-j", "2", "-f", "logs"]
STUDY = """
environments:
  one: {{id: Removing-v0, n_timesteps: 100000000, env_kwargs: {{folder: {folder}, by: {by}}}}}
agents: {{one: {{algo: qlearning}}}}
seeds: 3
"""
COMMANDS = {
    "a run": (TRAINING, "logs/qlearning/Removing-v0_1", "removing"),
    "a search": (TUNE, "logs/Removing-v0_qlearning", "removing"),
    "all studies": (COMPARE, "logs", "renaming"),
}
GONE = "this folder is gone: somebody has removed or renamed it"


def words_for(own_folder, words, folder, by):
    """The words of a command, in which an environment removes a folder."""
    there = own_folder / folder
    (own_folder / "removing.py").write_text(REMOVING)
    (own_folder / "study.yml").write_text(STUDY.format(folder=there, by=by))
    settings = ["--env", "Removing-v0", "--env-kwargs", f"folder:'{there}'", f"by:'{by}'"]
    return [*words, "--gym-packages", "removing", *([] if "study.yml" in words else settings)]


@pytest.mark.parametrize("what", COMMANDS)
def test_a_folder_that_is_gone_ends_the_command(type_in_own_folder, own_folder, what):
    words, folder, by = COMMANDS[what]
    code, out, err = type_in_own_folder(*words_for(own_folder, words, folder, by))
    assert (code, err.count("\n")) == (2, 1), err
    assert err.startswith(f"{words[0]}: error: logs/")
    assert err.endswith(f": {GONE}\n")
    assert "another" not in out
    assert not (own_folder / folder).exists()


@pytest.mark.skipif(sys.platform != "linux", reason="it looks into /proc")
def test_no_process_is_left_of_a_study_whose_folder_is_gone(own_folder):
    words = words_for(own_folder, COMPARE, "logs/study", "removing")
    command = [sys.executable, ROOT / words[0], *words[1:]]
    done = subprocess.run(command, check=False, timeout=120, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (2, f"compare.py: error: logs/study: {GONE}\n")
    deadline = time.monotonic() + 20
    while (left := processes_in(own_folder)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not left
    assert not (own_folder / "logs" / "study").exists()


def processes_in(folder):
    """The other processes whose working folder it is."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            found += [int(process.name)] if (process / "cwd").samefile(folder) else []
    return set(found) - {os.getpid()}

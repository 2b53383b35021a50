"""Links and pipes in the place of files of a stranger's folder: no way out, and no waiting."""

import json
import os
import shutil
import signal
from itertools import cycle
from pathlib import Path

import pytest
from rich.console import Console

from rl_yardstick.pipeline.digests import RECORD, sealed
from rl_yardstick.pipeline.settings.hyperparams import split
from rl_yardstick.pipeline.train_spec import TrainSpec

SECRET = b"GIF89a the key to everything"
LAKE, CART = "FrozenLake-v1", "CartPole-v1"
SMALL = {"n_steps": 16, "batch_size": 16, "n_epochs": 1, "policy_kwargs": {"net_arch": [4]}}
AGENTS = {
    "table": ("qlearning", LAKE, {}),
    "network": ("ppo", CART, {**SMALL, "normalize": True}),
}
READ = (RECORD, f"{CART}.zip", CART, f"{CART}/config.yml", f"{CART}/vecnormalize.pkl")
READ += ("replay_buffer.pkl", "vec_normalize.pkl", "modules", "aaa.gif")
STUDY = ("--env", LAKE, "--algos", "random", "--seeds", "2", "-n", "20", "--no-report", "-j", "1")
STUDY_NAMES = ("looks.json", "summary.csv", "curves.csv.gz", "report.html", "verdicts.md", ".lock")
STUDY_NAMES += (".drafts", "failures", "figures", "films", "learning", "replaced", "runs")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A finished run of each kind of agent."""
    from rl_yardstick.pipeline.training import train as do_training

    folder, found = tmp_path_factory.mktemp("runs"), {}
    for kind, (algo, env_id, settings) in AGENTS.items():
        raw = {"n_timesteps": 64, **settings}
        fields = {"eval_episodes": 1, "n_eval_envs": 1, "device": "cpu", "verbose": 0}
        spec = TrainSpec(algo, env_id, split(raw), raw, 0, log_folder=folder, **fields)
        found[kind] = do_training(spec, Console(quiet=True), {}, "train.py").run
    return found


@pytest.fixture
def outside(tmp_path):
    """What no command may read or write: files and a folder beside the user's own."""
    folder = tmp_path / "outside"
    (folder / "inner").mkdir(parents=True)
    (folder / "key").write_bytes(SECRET)
    (folder / "inner" / "key").write_bytes(SECRET)
    return folder


@pytest.fixture
def type_command(type_command, tmp_path, monkeypatch):
    """Run a command in a folder of its own, where it may not take long: exit code, all output."""
    (tmp_path / "own").mkdir()
    monkeypatch.chdir(tmp_path / "own")

    def run(*words):
        signal.signal(signal.SIGALRM, lambda *_: pytest.fail(f"{words[0]} hangs"))
        signal.alarm(250)  # seconds: a busy machine is slow, and a pipe waits for ever
        try:
            code, out, err = type_command(*words)
        finally:
            signal.alarm(0)
        assert code in (0, 2) or "inspect" in words, err
        assert code != 2 or err.count("\n") == 1, err
        return code, out + err

    return run


def substitutes(outside, name, original):
    """What takes the place of a name: links to files, one like the original, folders."""
    like = outside / f"like {name.replace('/', ' ')}"
    if original.is_dir():
        shutil.copytree(original, like, dirs_exist_ok=True)
    elif original.exists():
        like.write_bytes(original.read_bytes())
    return {
        "key": lambda path: path.symlink_to(outside / "key"),
        "like": lambda path: path.symlink_to(like),
        "folder": lambda path: path.symlink_to(outside / "inner"),
        "pipe": os.mkfifo,
    }


def held_in(folder):
    return {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}


def attack(genuine, names, outside, copies, act):
    """Put a substitute in the place of each name of a copy, act on it, and look outside."""
    of_what_is_there = cycle(("like", "key", "pipe"))
    of_others = cycle(("key", "folder", "pipe"))
    for name in names:
        what = next(of_what_is_there if (genuine / name).exists() else of_others)
        shutil.rmtree(copies, ignore_errors=True)
        shutil.copytree(genuine, copies)
        path = copies / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        path.parent.mkdir(exist_ok=True)
        substitutes(outside, name, genuine / name)[what](path)
        before = held_in(outside)
        act(f"{name} is {what}")
        assert held_in(outside) == before, f"{name} is {what}: written outside"


def check_untold(said, own):
    assert SECRET.decode() not in said
    for path in own.rglob("*"):
        if path.is_file() and not path.is_symlink():
            assert SECRET not in path.read_bytes(), path


def rewrite(folder, **fields):
    info = json.loads((folder / RECORD).read_text())
    (folder / RECORD).write_text(json.dumps(sealed({**info, **fields})))
    return info


# --- runs ----------------------------------------------------------------------------------------


def test_a_finished_run(runs, outside, type_command):
    genuine = runs["network"].path
    own = Path.cwd()
    copy = own / genuine.name

    def act(told):
        play = ("--render", "none", "--n-episodes", "1")
        said = [type_command("enjoy.py", copy, *play), type_command("pack", copy, own / "pack.zip")]
        if ".zip is" in told:
            said.append(type_command("yardstick", "inspect", copy / f"{CART}.zip"))
        if told.startswith((f"{CART}.zip is", f"{CART}/vecnormalize.pkl is")):
            words = ("--algo", "ppo", "--env", CART, "-n", "16", "-f", own / "logs")
            small = ("-params", "n_steps:16", "batch_size:16")
            said.append(type_command("train.py", *words, "-i", copy, "--eval-freq", "-1", *small))
        check_untold("".join(text for _, text in said), own)
        if told.startswith(f"{CART}.zip is"):
            assert {said[0][0], said[1][0], said[-1][0]} == {2}, told
        (own / "pack.zip").unlink(missing_ok=True)

    attack(genuine, READ, outside, copy, act)


def test_a_run_of_a_stranger_is_begun_again_and_writes_over_no_page(runs, type_command, outside):
    copy = Path.cwd() / "logs" / "qlearning" / "FrozenLake-v1_1"
    shutil.copytree(runs["table"].path, copy)
    rewrite(copy, state="interrupted")  # with a seal as anybody can make it
    spec = {**rewrite(copy)["spec"], "watch_learning": str(outside / "key")}
    events = outside / "events.out.tfevents.1"
    events.write_bytes(b"mine")
    rewrite(copy, spec=spec, tensorboard=str(outside))
    code, said = type_command("train.py", "--resume", copy)
    assert code == 0, said
    assert "is there already and stays" in said
    assert (outside / "key").read_bytes() == SECRET
    assert events.read_bytes() == b"mine"


# --- studies --------------------------------------------------------------------------------------


def test_a_study(outside, type_command):
    root = Path.cwd() / "logs" / "studies"
    assert type_command("compare.py", *STUDY, "--name", "whole")[0] == 0
    whole = root / "whole"

    def act(told):
        repair = ("--repair",) if "is like" in told else ()
        code, said = type_command("compare.py", *STUDY, "--name", "copy", *repair)
        assert code == 2, told
        check_untold(said, Path.cwd())

    run = "runs/random/FrozenLake-v1_1"
    names = [*STUDY_NAMES, "failures/x.txt", "replaced/1", f"{run}/{RECORD}", run, "runs/random"]
    attack(whole, names, outside, root / "copy", act)

"""Unfinished runs: whose are left alone, and whose are cleared away."""

import os
import platform
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from experiments import run_in_child
from experiments.run_in_child import (
    claim_draft,
    do_run,
    draft_path,
    make_folder,
    remove_dead_drafts,
    remove_draft,
)
from experiments.study_plan import plan
from experiments.study_spec import AgentSpec, EnvironmentSpec, StudySpec

HERE = platform.node()


def draft_of(root, pid, machine=HERE):
    """A draft as a process of that number has left it on that machine."""
    draft = root / ".drafts" / f"{pid}@{machine}@qlearning@lake_1"
    (draft / "inner").mkdir(parents=True)
    (draft / "inner" / "0.monitor.csv").write_text("half a li")
    return draft


@pytest.fixture
def dead_pid():
    """The number of a process that was, and is no more."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    assert process.wait() == 0
    return process.pid


@pytest.fixture
def live_pid():
    """The number of another process that is at work."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        yield process.pid
        process.communicate(b"\n")


def test_what_a_dead_process_has_left_is_removed(tmp_path, dead_pid):
    draft_of(tmp_path, dead_pid)
    remove_dead_drafts(tmp_path)
    assert list(tmp_path.rglob("*dead*")) == []
    # With the folders that are empty now, up to the study's own.
    assert not tmp_path.exists()


def test_what_a_live_process_writes_stays(tmp_path, live_pid):
    drafts = [draft_of(tmp_path, pid) for pid in (live_pid, os.getpid())]
    remove_dead_drafts(tmp_path)
    assert [(draft / "inner" / "0.monitor.csv").is_file() for draft in drafts] == [True, True]


def test_of_another_machine_nothing_is_known(tmp_path, dead_pid):
    draft = draft_of(tmp_path, dead_pid, machine=f"{HERE}2")
    remove_dead_drafts(tmp_path)
    assert draft.is_dir()


def test_each_draft_is_judged_by_itself(tmp_path, dead_pid, live_pid):
    dead, alive = draft_of(tmp_path, dead_pid), draft_of(tmp_path, live_pid)
    elsewhere = draft_of(tmp_path, dead_pid, machine="elsewhere")
    nobodys = draft_of(tmp_path, "nobody")
    remove_dead_drafts(tmp_path)
    assert [path.exists() for path in (dead, alive, elsewhere, nobodys)] == [0, 1, 1, 0]
    assert sorted((tmp_path / ".drafts").iterdir()) == sorted([alive, elsewhere])


def test_a_process_of_another_user_is_alive(tmp_path, dead_pid, monkeypatch):
    def refuse(pid, signal):
        assert (pid, signal) == (dead_pid, 0)
        raise PermissionError

    monkeypatch.setattr(os, "kill", refuse)
    draft = draft_of(tmp_path, dead_pid)
    remove_dead_drafts(tmp_path)
    assert draft.is_dir()


class _Windows:
    """What Windows says of three processes: one at work, one that has ended, another user's."""

    SYNCHRONIZE, WAIT_OBJECT_0, WAIT_TIMEOUT = 0x100000, 0, 0x102

    def __init__(self):
        self.n_open = 0

    def OpenProcess(self, access, inherit, pid):  # noqa: N802  # that is what it is called
        assert (access, inherit) == (self.SYNCHRONIZE, False)
        if pid == 3:
            raise PermissionError
        if pid > 3:
            raise OSError(22, "the parameter is incorrect")
        self.n_open += 1
        return pid

    def WaitForSingleObject(self, handle, milliseconds):  # noqa: N802
        assert milliseconds == 0
        return {1: self.WAIT_TIMEOUT, 2: self.WAIT_OBJECT_0}[handle]

    def CloseHandle(self, handle):  # noqa: N802
        self.n_open -= 1


def test_on_windows_nothing_is_sent_to_the_process(tmp_path, monkeypatch):
    windows = _Windows()
    monkeypatch.setitem(sys.modules, "_winapi", windows)
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.delattr(os, "kill")
    drafts = [draft_of(tmp_path, pid) for pid in (1, 2, 3, 4)]
    runpy.run_path(run_in_child.__file__)["remove_dead_drafts"](tmp_path)
    assert [draft.exists() for draft in drafts] == [True, False, True, False]
    assert windows.n_open == 0


def test_a_draft_that_cannot_be_renamed_is_removed_all_the_same(tmp_path, monkeypatch):
    """Windows renames no folder of which somebody has a file open."""
    draft = draft_of(tmp_path, 1)

    def refuse(path, target):
        raise PermissionError(13, "is being used by another process", str(path))

    monkeypatch.setattr(Path, "replace", refuse)
    remove_draft(draft)
    assert not draft.exists()


def test_where_there_are_no_drafts_nothing_happens(tmp_path):
    remove_dead_drafts(tmp_path)
    remove_dead_drafts(tmp_path / "never")
    assert list(tmp_path.iterdir()) == []


def test_removing_a_draft_leaves_the_others_and_the_study(tmp_path):
    first, second = draft_of(tmp_path, 1), draft_of(tmp_path, 2)
    (tmp_path / "study.yml").touch()
    remove_draft(first)
    assert sorted(tmp_path.rglob("*@*")) == [second]
    remove_draft(second)
    assert [path.name for path in tmp_path.iterdir()] == ["study.yml"]
    remove_draft(second)


def test_a_draft_says_whose_it_is(tmp_path):
    lake = EnvironmentSpec("dry lake", "FrozenLake-v1", {"n_timesteps": 10})
    study = StudySpec("s", "S", (AgentSpec("mine", "qlearning"),), (lake,), n_seeds=2)
    paths = [draft_path(tmp_path, run) for run in plan(study, tmp_path)]
    assert {path.parent for path in paths} == {tmp_path / ".drafts"}
    assert [path.name for path in paths] == [
        f"{os.getpid()}@{HERE}@mine@dry_lake_{number}" for number in (1, 2)
    ]


def test_a_draft_of_long_labels_has_a_name_that_can_be_made(tmp_path):
    names = ["ä" * 90, "ö" * 90]
    lake = EnvironmentSpec(names[0], "FrozenLake-v1", {"n_timesteps": 10})
    study = StudySpec("s", "S", (AgentSpec(names[1], "qlearning"),), (lake,), n_seeds=2)
    paths = [draft_path(tmp_path, run) for run in plan(study, tmp_path)]
    assert len({path.name for path in paths}) == 2
    for path in paths:
        make_folder(path.with_name(f"{path.name}.dead"))


@pytest.mark.parametrize(
    ("algo", "env_id"), [("qlearning", "CartPole-v1"), ("ucb", "GaussianBandit-v0")]
)
def test_no_file_of_a_run_is_open_when_it_is_renamed_into_place(
    tmp_path, monkeypatch, algo, env_id
):
    """Windows would not rename the folder."""

    def note(draft, path):
        names = [os.path.realpath(file) for file in Path("/proc/self/fd").iterdir()]
        still_open.append([name for name in names if name.startswith(str(draft))])
        assert (draft / "run.json").is_file()

    still_open = []
    monkeypatch.setattr(run_in_child, "put_in_place", note)
    env = EnvironmentSpec(env_id, env_id, {"n_timesteps": 60})
    study = StudySpec("s", "S", (AgentSpec(algo, algo),), (env,), n_seeds=1)
    (planned,) = plan(study, tmp_path)
    do_run(planned, draft_path(tmp_path, planned), "")
    assert still_open == [[]]


def test_a_draft_is_a_new_folder_whatever_lies_there(tmp_path):
    """Its name can be told beforehand, and a link there would lead out."""
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").touch()
    draft = tmp_path / "study" / ".drafts" / "1@here@mine@lake_1"
    draft.parent.mkdir(parents=True)
    draft.symlink_to(outside)
    claim_draft(draft)
    assert draft.is_dir()
    assert not draft.is_symlink()
    assert [path.name for path in draft.parent.iterdir()] == [draft.name]
    (draft / "left over").touch()
    claim_draft(draft)
    assert list(draft.iterdir()) == []
    assert [path.name for path in outside.iterdir()] == ["precious"]


def test_a_folder_is_made_while_another_run_removes_it(tmp_path, monkeypatch):
    """The folder above vanishes just before the first tries."""
    tries, mkdir = [], Path.mkdir

    def vanishing(path, *args, **kwargs):
        tries.append(path)
        if len(tries) <= 3:
            raise FileNotFoundError(path)
        mkdir(path, *args, **kwargs)

    monkeypatch.setattr(Path, "mkdir", vanishing)
    make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    make_folder(tmp_path / "a" / "b")


def test_a_folder_that_can_never_be_made_is_an_error(tmp_path, monkeypatch):
    def never(path, *args, **kwargs):
        raise FileNotFoundError("never")

    monkeypatch.setattr(Path, "mkdir", never)
    with pytest.raises(FileNotFoundError, match="never"):
        make_folder(tmp_path / "a")

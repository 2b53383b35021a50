"""Unfinished runs: whose are left alone, and whose are cleared away."""

import os
import platform
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from experiments import run_folders
from experiments.plan import plan
from experiments.results import mixed_versions
from experiments.run_folders import (
    check_settings_kept,
    claim_draft,
    draft_path,
    in_the_way,
    leave_drafts,
    move_replaced_aside,
    remove_dead_drafts,
    remove_draft,
    take_over,
)
from experiments.run_in_child import do_run
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline import files, locks
from pipeline.errors import UserError
from pipeline.runs import FINISHED

HERE = platform.node()
RUN = "qlearning@lake_1"


def draft_of(root, process, machine=HERE, state=False, run=RUN):
    """A draft as a process has left it on that machine: what it is called, or its number."""
    owner = process if isinstance(process, str) else owner_of(process)
    draft = root / ".drafts" / f"{owner}@{machine}@{run}"
    (draft / "inner").mkdir(parents=True)
    (draft / "inner" / "0.monitor.csv").write_text("half a li")
    if state:
        (draft / "state").mkdir()
        (draft / "state" / "odd.state").write_text("far")
    return draft


def owner_of(pid):
    """How drafts name a process of this machine that is there, or was."""
    mark = locks.mark()
    stat = Path(f"/proc/{pid}/stat")
    began = stat.read_text().rpartition(")")[2].split()[19] if stat.exists() else 1
    return f"{pid}-{began}-{run_folders._place(mark)}"


def let_pass(draft, seconds):
    then = draft.stat().st_mtime - seconds
    os.utime(draft, (then, then))


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


@pytest.mark.parametrize("owner", ["1-1-00000000", "nobody"])
def test_elsewhere_a_process_counts_as_gone_once_it_is_silent(tmp_path, owner):
    """On another machine, or before the last boot."""
    draft = draft_of(tmp_path, owner, machine="elsewhere")
    remove_dead_drafts(tmp_path)
    assert draft.is_dir()
    let_pass(draft, 44)
    remove_dead_drafts(tmp_path)
    assert draft.is_dir()
    let_pass(draft, 46)
    remove_dead_drafts(tmp_path)
    assert not tmp_path.exists()


def test_a_number_that_is_used_again_is_another_process(tmp_path, live_pid):
    owner = owner_of(live_pid).split("-")
    draft = draft_of(tmp_path, f"{owner[0]}-1-{owner[2]}")
    remove_dead_drafts(tmp_path)
    assert not draft.exists()


def test_each_draft_is_judged_by_itself(tmp_path, dead_pid, live_pid):
    dead, alive = draft_of(tmp_path, dead_pid), draft_of(tmp_path, live_pid)
    elsewhere = draft_of(tmp_path, "1-1-00000000", machine="elsewhere")
    remove_dead_drafts(tmp_path)
    assert [path.exists() for path in (dead, alive, elsewhere)] == [0, 1, 1]
    assert sorted((tmp_path / ".drafts").iterdir()) == sorted([alive, elsewhere])


def test_a_draft_is_kept_for_a_run_that_is_still_to_do(tmp_path, dead_pid):
    draft = draft_of(tmp_path, f"{dead_pid}-2-{run_folders._place(locks.mark())}")
    remove_dead_drafts(tmp_path, {RUN})
    assert draft.is_dir()
    leave_drafts(tmp_path, RUN)
    assert not draft.exists()
    # One with a state waits for the next command.
    draft = draft_of(tmp_path, dead_pid, state=True)
    remove_dead_drafts(tmp_path, {RUN})
    leave_drafts(tmp_path, RUN)
    assert draft.is_dir()
    remove_dead_drafts(tmp_path, {"qlearning@lake_2"})
    assert not tmp_path.exists()


def test_what_this_process_has_left_without_a_state_is_removed(tmp_path):
    draft = draft_of(tmp_path, os.getpid())
    leave_drafts(tmp_path, "another run")
    assert draft.is_dir()
    leave_drafts(tmp_path, RUN)
    assert not draft.exists()


def test_the_next_process_takes_over_what_a_dead_one_has_left(tmp_path, dead_pid, live_pid):
    own = tmp_path / ".drafts" / f"{owner_of(os.getpid())}@{HERE}@{RUN}"
    assert not take_over(own)
    draft_of(tmp_path, dead_pid, run="qlearning@lake_2", state=True)
    draft_of(tmp_path, live_pid, state=True)
    assert not take_over(own)
    assert not own.exists()
    stateless = draft_of(tmp_path, f"{dead_pid}-2-{run_folders._place(locks.mark())}")
    left = draft_of(tmp_path, dead_pid, state=True)
    assert take_over(own)
    assert not left.exists()
    assert (own / "state" / "odd.state").read_text() == "far"
    # What holds no state says that the run was cut off before its first.
    remove_draft(own)
    assert take_over(own)
    assert not stateless.exists()
    assert own.is_dir()


def test_a_link_is_taken_over_by_nobody(tmp_path, dead_pid):
    outside = draft_of(tmp_path / "outside", dead_pid, state=True)
    link = tmp_path / ".drafts" / outside.name
    link.parent.mkdir()
    link.symlink_to(outside)
    assert not take_over(link.with_name(f"{owner_of(os.getpid())}@{HERE}@{RUN}"))


def test_another_process_was_faster(tmp_path, dead_pid, monkeypatch):
    draft = draft_of(tmp_path, dead_pid, state=True)

    def gone(path, target):
        raise FileNotFoundError(path)

    monkeypatch.setattr(Path, "replace", gone)
    assert not take_over(draft.with_name(f"{owner_of(os.getpid())}@{HERE}@{RUN}"))


def test_a_draft_that_cannot_be_renamed_is_removed_all_the_same(tmp_path, monkeypatch):
    """Windows renames no folder of which somebody has a file open."""
    draft = draft_of(tmp_path, "1")

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
    first, second = draft_of(tmp_path, "1"), draft_of(tmp_path, "2")
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
        f"{owner_of(os.getpid())}@{HERE}@mine@dry_lake_{number}" for number in (1, 2)
    ]


def test_a_draft_of_long_labels_has_a_name_that_can_be_made(tmp_path):
    names = ["ä" * 90, "ö" * 90]
    lake = EnvironmentSpec(names[0], "FrozenLake-v1", {"n_timesteps": 10})
    study = StudySpec("s", "S", (AgentSpec(names[1], "qlearning"),), (lake,), n_seeds=2)
    paths = [draft_path(tmp_path, run) for run in plan(study, tmp_path)]
    assert len({path.name for path in paths}) == 2
    for path in paths:
        claim_draft(path.with_name(f"{path.name}.dead"))


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
    monkeypatch.setattr(run_folders, "put_in_place", note)
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
    claim_draft(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


def test_a_folder_is_made_that_another_run_removes_as_soon_as_it_is_found(tmp_path, monkeypatch):
    folder, is_dir = tmp_path / "a", Path.is_dir
    folder.mkdir()

    def vanishing(path):
        folder.rmdir()
        monkeypatch.setattr(Path, "is_dir", is_dir)
        return False

    monkeypatch.setattr(Path, "is_dir", vanishing)
    claim_draft(folder / "b")
    assert (folder / "b").is_dir()


def test_a_file_where_a_folder_should_be_is_an_error(tmp_path):
    (tmp_path / "a").touch()
    with pytest.raises(FileExistsError):
        claim_draft(tmp_path / "a" / "b")


def test_a_folder_that_can_never_be_made_is_an_error(tmp_path, monkeypatch):
    def never(path, *args, **kwargs):
        raise FileNotFoundError("never")

    monkeypatch.setattr(Path, "mkdir", never)
    with pytest.raises(FileNotFoundError, match="never"):
        claim_draft(tmp_path / "a" / "b")


# --- Finished runs of other settings: named, kept, and moved aside when that is asked for.

LAKE = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 20})
ARMS = EnvironmentSpec("arms", "BernoulliBandit-v0", {"n_timesteps": 20})


def study_of(algo="qlearning", environment=LAKE, n_seeds=2, **settings):
    agent = AgentSpec("mine", algo, settings)
    return StudySpec("s", "S", (agent,), (environment,), n_seeds=n_seeds)


@pytest.fixture
def done(tmp_path, do_study):
    do_study(study_of(), tmp_path)
    return tmp_path


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.json")}


def test_other_settings_are_refused_by_name(done):
    planned = plan(study_of(gamma=0.5), done)
    before = contents(done)
    words = (
        f"{done}: 2 finished runs have other settings (gamma: 0.995 there, 0.5 now): --name NAME"
    )
    with pytest.raises(UserError, match=f"^{re.escape(words)} .*, --replace "):
        check_settings_kept(planned, done)
    assert contents(done) == before


def test_of_many_differences_three_are_named(done):
    study = replace(
        study_of(gamma=0.5, learning_rate=0.2, initial_q=2.0), eval_freq=7, eval_episodes=3
    )
    with pytest.raises(UserError, match=r"; and 2 more\)"):
        check_settings_kept(plan(study, done), done)


@pytest.mark.parametrize("n_seeds", [1, 2, 5])
def test_more_or_fewer_seeds_go_without_a_word(done, n_seeds):
    planned = plan(study_of(n_seeds=n_seeds), done)
    check_settings_kept(planned, done)
    assert move_replaced_aside(planned, done) == ([], None)
    assert [run.is_finished for run in planned] == [True, True, False, False, False][:n_seeds]


def test_what_is_moved_aside_is_whole_and_each_time_elsewhere(done, do_study):
    before = contents(done / "runs")
    for number, gamma in enumerate((0.5, 0.6), start=1):
        study = study_of(gamma=gamma)
        planned = plan(study, done)
        moved, place = move_replaced_aside(planned, done)
        assert (moved, place) == (planned, done / "replaced" / str(number))
        assert contents(place) == before
        check_settings_kept(planned, done)
        do_study(study, done)
        before = contents(done / "runs")


def test_a_batch_of_more_seeds_takes_the_place_of_one_of_fewer(tmp_path, do_study):
    do_study(study_of("ucb", ARMS), tmp_path)
    planned = plan(study_of("ucb", ARMS, n_seeds=3), tmp_path)
    check_settings_kept(planned, tmp_path)
    assert in_the_way(planned) == planned
    assert move_replaced_aside(planned, tmp_path) == (planned, tmp_path / "replaced" / "1")
    do_study(study_of("ucb", ARMS), tmp_path)
    planned = plan(study_of("ucb", replace(ARMS, settings={"n_timesteps": 30})), tmp_path)
    with pytest.raises(UserError, match=r"1 finished run has other settings \(n_timesteps"):
        check_settings_kept(planned, tmp_path)


def test_first_runs_with_checkpoints_take_the_place_of_those_without(done):
    planned = plan(replace(study_of(), render_every=2), done)
    check_settings_kept(planned, done)
    assert in_the_way(planned) == planned[:1]


def test_a_run_that_was_cut_off_is_kept_and_an_empty_folder_is_not(done):
    planned = plan(study_of(n_seeds=4), done)
    planned[0].run.update_info(state="interrupted")
    planned[2].path.mkdir()
    check_settings_kept(planned, done)
    assert move_replaced_aside(planned, done) == (planned[:1], done / "replaced" / "1")
    assert not planned[2].path.exists()


def test_another_driver_deletes_nothing_either(done):
    """Programs of a user's own take no lock, and come without being checked."""
    (run, _) = plan(study_of(gamma=0.5), done)
    before = contents(run.path)
    do_run(run, draft_path(done, run), "c")
    assert run.is_finished
    assert contents(done / "replaced" / "1" / "mine" / "lake_1") == before


def test_versions_that_differ_are_named():
    infos = [{"versions": {"torch": "2.1", "numpy": "2.0"}}] * 2
    assert mixed_versions(infos) == mixed_versions([]) == mixed_versions([{}]) == ""
    infos = [*infos, {"versions": {"torch": "2.2", "numpy": "2.0"}, "n_runs": 9}]
    expected = "runs were done with different versions: torch 2.1 (2 runs), 2.2 (9 runs)"
    assert mixed_versions(infos) == expected


# --- What the disk has of a run of a study, and when.


def test_a_draft_is_on_the_disk_before_it_has_its_name(monkeypatch, tmp_path):
    """After a power cut no folder of a run may be there whose files are not."""
    house = EnvironmentSpec("house", "Warehouse-v0", {"n_timesteps": 200})
    agent = AgentSpec("table", "qlearning", tuned=False)
    [run] = plan(StudySpec("s", "S", (agent,), (house,), n_seeds=1), tmp_path)
    events = []
    fsync, put = os.fsync, run_folders.put_in_place

    def synced(number):
        events.append(Path(f"/proc/self/fd/{number}").readlink().name)
        fsync(number)

    def named(*args):
        events.append("named")
        put(*args)

    monkeypatch.setattr(files.os, "fsync", synced)
    monkeypatch.setattr(run_folders, "put_in_place", named)
    do_run(run, run_folders.draft_path(tmp_path, run), "")
    assert run.run.read_info()["state"] == FINISHED
    place = events.index("named")
    assert {path.name for path in run.path.rglob("*")} <= set(events[:place])
    assert run.path.parent.name in events[place:]

"""What a worker may answer, and what is refused before anything of it is written."""

import io
import json
import shutil
import warnings
import zipfile
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.cluster import answers
from experiments.cluster.answers import (
    Answer,
    RefusedAnswerError,
    check_in_place,
    files_in,
    packed,
    receive,
    sealed,
    unpacked,
)
from experiments.cluster.cluster_launcher import MOST_SENDS, SentRun
from experiments.cluster.working import Probe, RunOrder, probing
from experiments.plan import plan
from experiments.run_folders import draft_path
from experiments.run_in_child import do_run
from experiments.run_limits import RunLimits
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec

FILES = {"run/run.json": b"{}", "run/a/b.zip": b"\0\1", "tensorboard/x": b""}


def raw(files=(), **changes):
    head = {"kind": "done", "reason": "", "details": "", "has_files": True, **changes}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive, warnings.catch_warnings(action="ignore"):
        for name in ("answer.json", *files):
            archive.writestr(name, json.dumps(head))
    return sealed(buffer.getvalue())


@pytest.mark.parametrize(
    "answer",
    [
        Answer("done"),
        Answer("done", files={}),
        Answer("done", files=FILES),
        Answer("failed", "thin ice", "Traceback"),
        Answer("stopped"),
    ],
)
def test_what_is_packed_is_unpacked(answer):
    assert unpacked(packed(answer)) == answer


@given(st.binary(max_size=200))
def test_bytes_are_an_answer_or_refused(content):
    for read in (content, sealed(content)):
        with pytest.raises(RefusedAnswerError):
            unpacked(read)


@given(st.data())
def test_a_bit_that_is_turned_is_noticed(data):
    content = bytearray(packed(Answer("done", files=FILES)))
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(RefusedAnswerError, match="damaged"):
        unpacked(bytes(content))


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "run/../../x",
        "run/..",
        "run//x",
        "run/./x",
        "run/x/",
        "x",
        "run/a\\b",
        "run/a\nb",
        "run/c:x",
        "run/nul",
        "run/x.",
        "run/" + "d/" * 9 + "x",
        "run/" + "x" * 300,
    ],
)
def test_names_that_lead_elsewhere_are_refused(name):
    with pytest.raises(RefusedAnswerError):
        unpacked(raw([name]))


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (["run/x", "run/x"], "twice"),
        (["run/x", "run/X"], "twice"),
        (["run/x", "run/X/y"], "folder too"),
    ],
)
def test_files_that_cannot_lie_beside_each_other_are_refused(files, words):
    with pytest.raises(RefusedAnswerError, match=words):
        unpacked(raw(files))


@pytest.mark.parametrize(
    "changes", [{"kind": "fine"}, {"reason": 3}, {"details": None}, {"reason": "x" * 300_000}]
)
def test_heads_that_say_something_else_are_refused(changes):
    with pytest.raises(RefusedAnswerError):
        unpacked(raw(**changes))


@pytest.mark.parametrize(
    "content", [None, "text", {"kind": "done"}, bytearray(packed(Answer("done")))]
)
def test_what_is_no_bytes_is_refused(content):
    with pytest.raises(RefusedAnswerError, match="not bytes"):
        unpacked(content)


def test_there_are_bounds_on_what_is_sent_and_taken(tmp_path, monkeypatch):
    (tmp_path / "x").write_bytes(bytes(100))
    (tmp_path / "link").symlink_to("/etc/passwd")
    assert files_in(tmp_path, "run/") == {"run/x": bytes(100)}
    content = packed(Answer("done", files={"run/x": bytes(100)}))
    monkeypatch.setattr(answers, "LARGEST", 99)
    with pytest.raises(ValueError, match="let it share"):
        files_in(tmp_path, "run/")
    with pytest.raises(RefusedAnswerError, match="too large"):
        unpacked(content)


# --- What comes back of a run is put in place if it is that very run, whole, and nothing else.

LAKE = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 20})


def runs_of(root, tensorboard=False):
    agents = (AgentSpec("mine", "qlearning"),)
    return plan(StudySpec("s", "S", agents, (LAKE,), n_seeds=2, tensorboard=tensorboard), root)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """What a worker sends of the first run, by name."""
    root = tmp_path_factory.mktemp("worker")
    run = runs_of(root)[0]
    do_run(run, draft_path(root, run), "c")
    return files_in(run.path, "run/")


def test_a_run_is_put_in_place_to_the_last_bit(tmp_path, done):
    run = runs_of(tmp_path)[0]
    receive(run, tmp_path, done)
    assert run.is_finished
    assert files_in(run.path, "run/") == done
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    check_in_place(run)


def lacking(name):
    return lambda files: {key: data for key, data in files.items() if key != name}


def unfinished(files):
    record = json.loads(files["run/run.json"])
    del record["files"]
    return {**files, "run/run.json": json.dumps({**record, "state": "running"}).encode()}


LIES = {
    "no record": lacking("run/run.json"),
    "no evaluations": lacking("run/evaluations.npz"),
    "unfinished": unfinished,
    "a stray file": lambda files: {**files, "run/more.txt": b"x"},
    "other content": lambda files: {**files, "run/evaluations.npz": b"x"},
    "an empty record": lambda files: {**files, "run/run.json": b"{}"},
    "a changed record": lambda files: {
        **files,
        "run/run.json": files["run/run.json"].replace(b"seconds", b"secondS"),
    },
    "a file elsewhere": lambda files: {**files, "elsewhere/x": b"x"},
    "a log": lambda files: {**files, "tensorboard/x": b"x"},
    "no file name": lambda files: {**files, "run/\ud800": b"x"},
    "nothing": lambda files: {},
}


@pytest.mark.parametrize("lie", LIES)
def test_whatever_else_comes_is_refused_and_leaves_nothing(tmp_path, done, lie):
    with pytest.raises(RefusedAnswerError):
        receive(runs_of(tmp_path)[0], tmp_path, LIES[lie](done))
    assert not tmp_path.exists() or not list(tmp_path.rglob("*"))


def test_another_run_is_refused(tmp_path, done):
    other = runs_of(tmp_path)[1]
    with pytest.raises(RefusedAnswerError, match="another run"):
        receive(other, tmp_path, done)


def test_logs_go_to_their_own_folder(tmp_path, done):
    run = runs_of(tmp_path, tensorboard=True)[0]
    record = json.loads(done["run/run.json"])
    assert record["spec"]["tensorboard_log"] is None
    run.spec.tensorboard_log.mkdir(parents=True)
    (run.spec.tensorboard_log / "old").touch()
    receive(run, tmp_path, {**done, "tensorboard/events": b"x"})
    assert [path.name for path in run.spec.tensorboard_log.iterdir()] == ["events"]


def test_a_run_that_is_said_to_be_there_has_to_be(tmp_path, monkeypatch):
    monkeypatch.setattr(answers, "SECONDS_TO_APPEAR", 0.0)
    with pytest.raises(RefusedAnswerError, match="not in its folder"):
        check_in_place(runs_of(tmp_path)[0])


def test_a_shared_folder_is_known_by_what_lies_in_it(tmp_path):
    with probing(tmp_path) as probe:
        assert probe.is_there
        assert not replace(probe, content="x").is_there
        assert not replace(probe, root=tmp_path / "x").is_there
    assert not list(tmp_path.iterdir())


def test_apart_paths_stay_within_the_workers_folder(tmp_path):
    def order(root):
        run = runs_of(root, tensorboard=True)[0]
        return RunOrder(run, "c", RunLimits(), Probe(tmp_path, root, "n", "c"), "t", "v").apart()

    relative = order(tmp_path.relative_to(tmp_path) / "logs" / "s")
    assert relative.planned.path.parts[:3] == ("logs", "s", "runs")
    for root in (tmp_path, tmp_path.relative_to(tmp_path) / ".." / "s"):
        found = order(root)
        assert found.planned.path.parts[:2] == ("study", "runs")
        assert found.planned.spec.tensorboard_log.parts[:2] == ("study", "tensorboard")
        assert found.probe.root.parts == ("study",)
    shutil.rmtree(tmp_path)


@pytest.fixture
def sent(tmp_path):
    return SentRun(runs_of(tmp_path)[0])


def test_a_run_that_had_begun_is_blamed_for_its_workers_end(sent):
    for worker in "abc":
        sent.begin(worker, has_left=False)
        assert not sent.is_given_up
    sent.begin("d", has_left=False)
    assert sent.is_given_up
    assert sent.reason == "the worker that did it was lost 3 times (c)"


def test_one_that_waited_or_whose_worker_left_is_not(sent):
    for number in range(MOST_SENDS - 1):
        sent.n_sent += 1
        sent.begin(str(number), has_left=True)
        sent.lose(has_left=True)
        sent.lose(has_left=False)  # where it has not begun
    assert not sent.is_given_up
    sent.n_sent += 1
    assert sent.is_given_up
    assert "never came back" in sent.reason


def test_answers_that_are_refused_count(sent):
    for _ in range(3):
        assert not sent.is_given_up
        sent.begin("a", has_left=False)
        sent.refuse("nonsense")
    assert sent.is_given_up
    assert sent.reason == "3 times it did not come back as a run: nonsense"

"""Where trials are kept, as --storage says it, and drivers that share them."""

import pytest
from rl_yardstick.tuning.trial_storage import open_storage

from rl_yardstick.pipeline import locks
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.tuning import trial_storage
from rl_yardstick.tuning.tuning_spec import failing_in_a_line, kind_of, without_secret


def test_passwords_are_left_out_of_refusals_and_commands():
    with pytest.raises(UserError, match=r"'redis://u:\*\*\*@h' is no storage: a file for a "):
        kind_of("redis://u:secret@h")
    with pytest.raises(UserError) as error:
        open_storage(None, "postgresql://u:secret@127.0.0.1:1/db")
    assert "secret" not in str(error.value)
    assert "postgresql://u:***@127.0.0.1:1/db" in str(error.value)
    for text in ("tune.py --storage postgresql://u:se%40cret@h/db -j 2", "no://x"):
        assert without_secret(text) == text.replace("se%40cret", "***")


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ("notes.txt", r"notes\.txt: is there already, and no journal of trials"),
        ("cut.log", r"cut\.log: its last line is cut off: remove that line"),
        ("grpc://127.0.0.1:1", "there is no proxy: "),
    ],
)
def test_storages_that_are_none_are_refused_in_a_line(tmp_path, monkeypatch, given, complaint):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trial_storage, "SECONDS_TO_CONNECT", 0.2)
    files = {"notes.txt": "hello\n", "cut.log": '{"op_code":0}\n{"op'}
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=complaint) as error:
        open_storage(tmp_path, given)
    assert "\n" not in str(error.value)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == files


def test_a_folder_of_any_name_keeps_its_own_file_and_one_that_is_damaged_is_one_line(tmp_path):
    root = tmp_path / "a {b} %20 c?d"
    root.mkdir()
    storage = open_storage(root, None)
    storage.create_new_study([1], "s")
    assert (root / "trials.db").stat().st_size
    (root / "trials.db").write_bytes(b"no database any more")
    expected = r"^trials\.db: .*; finished work is kept, and the same"
    with pytest.raises(UserError, match=expected), failing_in_a_line(None):
        storage.create_new_study([1], "t")


# --- drivers that share a queue, and drivers that are gone ----------------------------------------


@pytest.fixture(params=["journal:{}/log", "sqlite:///{}/db"], ids=["journal", "sqlite"])
def storage(request, tmp_path):
    return request.param.format(tmp_path)


@pytest.fixture
def queue_of(toy, tmp_path):
    """The queue of a driver, with its places."""

    def queue(storage=None, **changes):
        found = toy.opened(toy.tuning(**changes), tmp_path, storage).queue
        found.add_places()
        return found

    return queue


@pytest.fixture
def elsewhere(monkeypatch):
    """Claims a trial as another process would, of this machine or of a far one."""

    def claim(queue, **changes):
        mark = locks.mark()
        with monkeypatch.context() as patch:
            patch.setattr(locks, "mark", lambda: {**mark, **changes})
            return queue.claim(lambda _: {})

    return claim


@pytest.fixture
def clock(monkeypatch):
    seconds = [0.0]
    monkeypatch.setattr(trial_storage.time, "monotonic", lambda: seconds[0])
    return seconds


def test_drivers_share_trials_and_take_up_those_of_one_that_is_gone(queue_of, storage, elsewhere):
    first, second, third = (queue_of(storage, n_trials=3) for _ in range(3))
    lost = elsewhere(first, began=1)  # not this process
    taken = [driver.claim(lambda _: {}).number for driver in (second, third)]
    assert [lost.number, *taken] == [0, 1, 2]
    assert second.claim(lambda _: {}) is None  # no more than were asked for
    assert third.free_dead() == [lost.number]
    assert second.claim(lambda _: {}).number == lost.number
    assert third.free_dead() == []


def test_one_elsewhere_counts_as_gone_once_it_has_been_silent(queue_of, elsewhere, clock):
    far, here = queue_of(), queue_of()
    trial = elsewhere(far, host="far", boot="another")
    for now, gives_sign, freed in [
        (0.0, True, []),
        (50.0, True, []),
        (100.0, False, []),
        (161.0, False, [trial.number]),
    ]:
        clock[0] = now
        if gives_sign:
            far.give_sign()
        assert here.free_dead() == freed

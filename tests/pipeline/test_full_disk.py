"""Where the disk takes no more, a run ends in one line, and run.json says what is true."""

import errno
import json

import pytest

from pipeline import files
from pipeline.runs import ROOM, ROOM_BYTES, Run


@pytest.fixture
def train_on_full_disk(type_in_own_folder, own_folder, monkeypatch):
    """Train while nothing can be written from a file of that name on, until room is made."""

    def train(name, room_helps=True):
        folder = own_folder / "logs" / "qlearning" / "FrozenLake-v1_1"
        put_in_place, full = files.put_in_place, []

        def put(draft, path, *opened):
            if path.name == name:
                assert (folder / ROOM).stat().st_size == ROOM_BYTES
                full.append(path)
            if full and not (room_helps and not (folder / ROOM).exists()):
                raise OSError(errno.ENOSPC, "No space left on device")
            put_in_place(draft, path, *opened)

        monkeypatch.setattr(files, "put_in_place", put)
        code, _, said = type_in_own_folder(
            *("train.py", "--env", "FrozenLake-v1", "--algo", "qlearning", "-n", "200"),
            *("--seed", "0", "--save-freq", "100", "--verbose", "0"),
        )
        monkeypatch.setattr(files, "put_in_place", put_in_place)
        return code, said, folder

    return train


MOMENTS = {
    "best_model.zip": (10, "no model"),
    "rl_model_100_steps.zip": (100, "best_model.zip"),
    "rl_model_200_steps.zip": (200, "best_model.zip and 1 checkpoint"),
    "FrozenLake-v1.zip": (200, "best_model.zip and 2 checkpoints"),
    "value_map.png": (200, "best_model.zip and 2 checkpoints"),
}


@pytest.mark.parametrize("name", MOMENTS)
def test_the_file_and_what_is_kept_are_named_and_the_run_has_failed(train_on_full_disk, name):
    n_steps, kept = MOMENTS[name]
    code, said, folder = train_on_full_disk(name)
    reason = f"{name}: No space left on device: the run has failed at step {n_steps}; "
    assert code == 2
    assert reason in said
    assert said.endswith(f"keeps {kept}\n")
    assert said.count("\n") == 1
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert record["state"] == "failed"
    assert name in record["reason"]
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]


def test_before_the_first_step_nothing_is_left(train_on_full_disk):
    code, said, folder = train_on_full_disk("config.yml")
    assert code == 2
    assert said.endswith("FrozenLake-v1/config.yml\n")
    assert said.count("\n") == 1
    assert not folder.parent.exists()


def test_the_record_stays_whole_where_not_even_that_can_be_written(train_on_full_disk):
    code, said, folder = train_on_full_disk("FrozenLake-v1.zip", room_helps=False)
    assert code == 2
    assert said.count("\n") == 1
    assert Run(folder, "FrozenLake-v1").read_info()["state"] == "running"


def test_a_run_that_ends_gives_its_room_back(train_on_full_disk):
    code, said, folder = train_on_full_disk("no such file")
    assert (code, said) == (0, "")
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]

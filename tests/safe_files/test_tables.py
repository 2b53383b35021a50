"""Files with tables as data: real forms in all protocols; attacks are refused, and run nothing."""

import collections
import io
import json
import pickle
import tracemalloc
from functools import partial

import numpy as np
import pytest
import torch as th

from rl_yardstick.safe_files.files import Budget, UnsafeFileError
from rl_yardstick.safe_files.tables import read_pickled_table, read_table_file
from tests.safe_files.test_attacks import Attack

VALUES = np.arange(12.0).reshape(4, 3)


def pairs():
    return {(state, action): VALUES[state, action] for state in range(4) for action in range(3)}


by_state, OF_A_COURSE = dict(enumerate(VALUES)), {"env_id": "Taxi-v4", "qtable": VALUES}
FORMS = {
    "an array": (VALUES, VALUES),
    "of another order and precision": (np.asfortranarray(VALUES, np.float32), VALUES),
    "a list": (VALUES.tolist(), VALUES.tolist()),
    "states": (by_state, by_state),
    "pairs": (pairs(), pairs()),
    "a default": (collections.defaultdict(partial(np.zeros, 3), by_state), by_state),
    "a default of 0": (collections.defaultdict(float, pairs()), pairs()),
    "ordered": (collections.OrderedDict(by_state), by_state),
    "a counter": (collections.Counter(pairs()), pairs()),
    "hands": ({(14, 10, False): [0.5, 1]}, {(14, 10, False): [0.5, 1]}),
    "numbers of NumPy": ({(np.int64(1), np.bool_(True)): np.float64(2)}, {(1, True): 2.0}),
    "texts": ({"(1, 2)": [0.5]}, {"(1, 2)": [0.5]}),
    "of a course": (OF_A_COURSE, OF_A_COURSE),
}


def same(one, other):
    if isinstance(other, dict):
        return list(one) == list(other) and all(map(same, one.values(), other.values()))
    return np.array_equal(one, other) if isinstance(other, np.ndarray) else one == other


@pytest.mark.parametrize("form", FORMS)
def test_pickled_forms_in_every_protocol(form):
    saved, read = FORMS[form]
    for protocol in range(6):
        content = pickle.dumps(saved, protocol=protocol)
        if protocol < 4:  # as NumPy 1 names it, where no length precedes the name
            content = content.replace(b"numpy._core", b"numpy.core")
        assert same(read_pickled_table(content, Budget(len(content))), read), protocol


class Counter(dict):
    """A course's own."""


def test_a_counter_of_another_module():
    content = pickle.dumps(Counter(pairs()))
    assert same(read_pickled_table(content, Budget(len(content))), pairs())


def huge_header(shape):
    written, header = io.BytesIO(), {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(written, header)
    return written.getvalue() + bytes(80)


ATTACKS = {  # more than `test_attacks.py` has, which tries its own here too
    "a call": pickle.dumps(Attack("mark")),
    "in a table": pickle.dumps({0: [1.0, Attack("mark")]}),
    "as a default": pickle.dumps({(0, Attack("mark")): 1.0}),
    "an array of petabytes": huge_header((1 << 40, 1 << 10)),
    "a shape below zero": huge_header((-1, 4)),
    "nothing": b" \n",
    "text": b"hello",
    "a cut file": pickle.dumps(VALUES)[:-9],
    "a cut zip": b"PK\3\4" + bytes(40),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_attacks_are_refused_in_one_line(attack, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tracemalloc.start()
    try:
        with pytest.raises(UnsafeFileError) as refusal:
            read_table_file(io.BytesIO(ATTACKS[attack]))
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()
    assert str(refusal.value).isprintable()
    assert list(tmp_path.iterdir()) == []


TEXTS = {
    "q.json": (json.dumps(VALUES.tolist()), VALUES.tolist()),
    "by_state.json": (json.dumps({"0": [1, 2]}), {"0": [1, 2]}),
    "q.csv": ("\n".join(",".join(map(str, row)) for row in VALUES), VALUES),
    "semicolons.csv": ("0;1\n2;3\n", np.array([[0.0, 1], [2, 3]])),
    "spaces.txt": ("# of savetxt\n0 1\n2 3\n", np.array([[0.0, 1], [2, 3]])),
    "pandas.csv": (",0,1\n0,5,6\n1,7,8\n", {"0": np.array([5.0, 6]), "1": np.array([7.0, 8])}),
    "named.csv": ("left,right\n1,2\n", np.array([[1.0, 2]])),
    "pairs.csv": ("state,action,q\n0,0,5\n0,1,6\n", {"0, 0": 5.0, "0, 1": 6.0}),
    "rows.csv": (",state,Action,q\n8,1,0,5\n9,0,1,6\n", {"1, 0": 5.0, "0, 1": 6.0}),
    "policy.csv": ("state,action\n0,5\n1,6\n", {"0": 5.0, "1": 6.0}),
    "hands.csv": ('"(14, 10, False)",1,2\n', {"(14, 10, False)": np.array([1.0, 2])}),
}


@pytest.mark.parametrize("name", TEXTS)
def test_texts(name, tmp_path):
    text, read = TEXTS[name]
    (tmp_path / name).write_text(text)
    assert same(read_table_file(tmp_path / name), read)


def test_files_of_numpy_and_torch(tmp_path):
    np.save(tmp_path / "q.npy", VALUES)
    np.save(tmp_path / "states.npy", by_state)
    np.savez(tmp_path / "q.npz", first=VALUES, second=VALUES.T)
    th.save({"table.weight": th.from_numpy(VALUES)}, tmp_path / "q.pt")
    assert same(read_table_file(tmp_path / "q.npy"), VALUES)
    assert same(read_table_file(tmp_path / "states.npy").item(), by_state)
    assert same(read_table_file(tmp_path / "q.npz"), {"first": VALUES, "second": VALUES.T})
    assert same(read_table_file(tmp_path / "q.pt"), {"table.weight": VALUES})

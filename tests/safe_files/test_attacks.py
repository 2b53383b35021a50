"""Pickles as data; those, and zips, that would run code or fill the memory are refused."""

import base64
import contextlib
import io
import json
import os
import pickle
import pickletools
import struct
import tracemalloc
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium.spaces import Box
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.utils import ConstantSchedule

from rl_yardstick.safe_files.buffers_and_statistics import load_replay_buffer, read_normalization
from rl_yardstick.safe_files.files import UnsafeFileError, read_model
from rl_yardstick.safe_files.known_objects import load_tensors, read_pickle
from rl_yardstick.safe_files.models import inspect_model, load_model
from rl_yardstick.safe_files.pickles import INSTRUCTIONS
from rl_yardstick.safe_files.tables import read_table_file

UTILS = "stable_baselines3.common.utils"
START = b"\x80\x04"
MB = 1 << 20


def text(value):
    return b"\x8c" + bytes([len(value)]) + value.encode()


def name(module, qualname):
    return text(module) + text(qualname) + b"\x93"


# A tuple of a tuple of ... that has 2**40 leaves.
LAYERS, TOP = b"N\x940" + b"".join(b"h%ch%c\x86\x940" % (i, i) for i in range(40)), b"h%c" % 40
DEQUE = name("collections", "deque")
CONSTANT = name(UTILS, "ConstantSchedule")
FROM_BUFFER = name("numpy._core.numeric", "_frombuffer")
FLOATS = name("numpy", "dtype") + text("f8") + b"\x89\x88\x87R"
NAN = b"G\x7f\xf8" + bytes(6)


def array(data, shape):
    """An array of float64 with a shape that is pickled already."""
    return FROM_BUFFER + b"(C" + bytes([len(data)]) + data + FLOATS + shape + text("C") + b"tR"


def with_state(maker, key, value):
    """A new object whose state has one attribute."""
    return maker + b")\x81}" + text(key) + value + b"sb"


# Instructions of protocol 4, between its beginning and its end.
ATTACKS = {
    "a call of the system": name("os", "system") + text("true") + b"\x85R",
    "getattr": name("builtins", "getattr"),
    "a way through attributes": name(UTILS, "FloatSchedule.__init__.__globals__"),
    "the state of a class, by slots": CONSTANT + b"N}" + text("__call__") + DEQUE + b"s\x86b",
    "an object that is called": CONSTANT + b")R)R",
    "an attribute that hides a method": with_state(CONSTANT, "__class__", b"K\x01"),
    "a space without its attributes":
        with_state(name("gymnasium.spaces.box", "Box"), "low", b"K\x01"),
    "lists in lists": b"]" * 5000 + b"a" * 4999,
    "an array of gigabytes": name("numpy._core.multiarray", "_reconstruct")
    + name("numpy", "ndarray") + b"J\xff\xff\xff\x7f\x85C\x01b\x87R",
    "a key whose hash takes for ever": LAYERS + b"}" + TOP + b"K\x01s",
    "a length that is not there": b"\x8e\xff\xff\xff\xff\xff\xff\xff\x7f",
    "two states": CONSTANT + b")\x81}b}b",
    "the state of a name": name("builtins", "int") + b"}b",
    "a state that is its own object": CONSTANT + b")\x81\x94}" + text("val") + b"h\x00sb",
    "an end before the beginning": b"0000",
    "an item of a name": name("os", "environ") + b"Na",
    "a place of the memo that is empty": b"h\x07",
    "an object among its own items": DEQUE + b")R\x94h\x00a",
    "a key that is an object": b"}" + DEQUE + b")RNs",
    "a long number of a megabyte": b"\x8b" + struct.pack("<i", 10**6) + bytes(10**6 - 1) + b"\x7f",
    "an array of no number": array(bytes(8), NAN + b"\x85"),
    "an array of 65 dimensions": array(bytes(8), b"(" + b"K\x01" * 65 + b"t"),
    "a deque of a length below 0": DEQUE + b")J\xfb\xff\xff\xff\x86R",
}  # fmt: skip
ATTACKS = {attack: START + instructions + b"." for attack, instructions in ATTACKS.items()} | {
    "a call of the system in protocol 0": b"cos\nsystem\n(S'true'\ntR.",
    "a call of the system in protocol 2": b"\x80\x02cos\nsystem\nX\4\0\0\0true\x85R.",
    "an object of the system in protocol 0": b"ccopy_reg\n_reconstructor\n(cos\nDirEntry\nNNtR.",
    "an object of no class": b"ccopy_reg\n_reconstructor\n(K\1c__builtin__\nobject\nNtR.",
    "a key in protocol 0 whose hash takes for ever": START + LAYERS + b"(" + TOP + b"Nd.",
    "an unpaired key in protocol 0": b"(V\nd.",
    "a place of thousands of digits": b"Np" + b"9" * 4000 + b"\n.",
    "lists in lists in protocol 0": b"(" * 500 + b"l" * 500 + b".",
    "bytes of a number": b"c_codecs\nencode\n(K\1V\ntR.",
    "bytes of many": b"c__builtin__\nbytes\n(J\xff\xff\xff\x7ftR.",
    "a set": START + b"\x8f(K\1\x90.",
    "a set of what takes for ever": START + LAYERS + b"\x8f(" + TOP + b"\x90.",
    "a name as a set": START + name("os", "environ") + b"(N\x90.",
    "an array of objects": pickle.dumps(np.array([print], dtype=object)),
    "a whole number of thousands of digits": pickle.dumps(10**5000),
    "an instance": b"(Vmkdir mark\nios\nsystem\n.",
    "a call of eval": b"cbuiltins\neval\n(Vopen('mark', 'w')\ntR.",
    "a dictionary that holds itself": START + b"}\x94K\1h\0s.",
}


@pytest.fixture(scope="module")
def genuine():
    """The members of a genuine zip."""
    kwargs = {"policy_kwargs": {"net_arch": [4]}, "device": "cpu"}
    return members_of(PPO("MlpPolicy", "CartPole-v1", **kwargs))


@pytest.fixture(scope="module")
def loaders(genuine):
    """What reads pickles: as statistics, as a buffer, and in the zip of a model."""
    agent = DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu")

    def in_zip(content):
        held = {":type:": "x", ":serialized:": base64.b64encode(content).decode()}
        return with_settings(genuine, invented=held)

    return {
        "statistics": read_normalization,
        "a buffer": lambda content: load_replay_buffer(agent, io.BytesIO(content)),
        "a zip": lambda content: load(in_zip(content)),
    }


@pytest.mark.parametrize("attack", ATTACKS)
def test_attacks_by_pickle_are_refused(attack, loaders, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tracemalloc.start()
    try:
        for read in (read_pickle, lambda content: read_table_file(io.BytesIO(content))):
            with pytest.raises(UnsafeFileError) as refusal:
                read(ATTACKS[attack])
            assert str(refusal.value).isprintable()
        assert tracemalloc.get_traced_memory()[1] < 70e6
    finally:
        tracemalloc.stop()
    for loader, read in loaders.items():
        with pytest.raises(UnsafeFileError) as refusal:
            read(ATTACKS[attack])
        assert str(refusal.value).isprintable(), loader
    assert ConstantSchedule(0.5)(1.0) == 0.5
    assert list(tmp_path.iterdir()) == []


def test_no_other_instruction_makes_or_fetches_anything():
    others = {op.name for op in pickletools.opcodes} - INSTRUCTIONS
    assert others >= {"INST", "OBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4", "PERSID", "NEXT_BUFFER"}


def members_of(agent):
    agent.save(content := io.BytesIO())
    with zipfile.ZipFile(content) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zip_of(members, method=zipfile.ZIP_STORED):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", method) as archive:
        for member, held in members.items():
            archive.writestr(member, held)
    return content.getvalue()


def load(members):
    return load_model(PPO, io.BytesIO(zip_of(members)))


def with_settings(genuine, **changes):
    return {**genuine, "data": json.dumps({**json.loads(genuine["data"]), **changes}).encode()}


class Attack:
    """Leaves a mark where it is unpickled."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.mkdir, (self.mark,)


def test_no_pickle_in_the_settings_is_run(genuine, tmp_path):
    mark = tmp_path / "mark"
    attack = base64.b64encode(pickle.dumps(Attack(mark))).decode()
    held = {":type:": "x", ":serialized:": attack}
    for key in ("policy_class", "invented", "learning_rate", "clip_range", "algorithm"):
        with pytest.raises(UnsafeFileError, match=key) as refusal:
            load(with_settings(genuine, **{key: held}))
        assert refusal.value.key == key
    # What the reader decides is not even read; an environment's id would import its module.
    for key in ("env", "_logger", "device", "_vec_normalize_env", "lr_schedule"):
        assert isinstance(load(with_settings(genuine, **{key: held})), PPO)
    model = load(with_settings(genuine, env="this:Zen-v0", tensorboard_log=str(mark)))
    assert model.env is model.tensorboard_log is None
    assert not mark.exists()


SPACE, OTHER = Box(-1, 1, (4,)), [ConstantSchedule(0.5), {"a": (1, "b")}, np.arange(4.0)]
WHOLE = [pickle.dumps([*OTHER, Attack("mark")], protocol) for protocol in (0, 2, 4)]
WHOLE += [pickle.dumps(SPACE, protocol) for protocol in (1, 4)]


@settings(max_examples=200, deadline=2000)
@given(st.sampled_from(WHOLE), st.data())
def test_changed_pickles_are_read_or_refused(whole, data):
    changed = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(whole) - 1))
        changed[place] = data.draw(st.sampled_from([*whole, *range(256)]))
    with contextlib.suppress(UnsafeFileError):
        read_pickle(bytes(changed))
    assert not Path("mark").exists()


def tensors(content):
    th.save(content, file := io.BytesIO())
    return file.getvalue()


NOT_A_NUMBER, OTHERS = float("nan"), {"policy.predict": th.zeros(1)}
NO_ATTRIBUTE, NO_MEMBER, NO_MODEL = "no attribute of a", "which no model file has", "no such model"
# What is changed in the settings, or put in place of a member; and what the refusal says.
CHANGES = {
    "a method": ({"predict": 1}, NO_ATTRIBUTE),
    "a class": ({"__class__": 1}, NO_ATTRIBUTE),
    "wide networks": ({"policy_kwargs": {"net_arch": [10**6, 10**6]}}, "memory"),
    "layers of no number": ({"policy_kwargs": {"net_arch": [NOT_A_NUMBER]}}, NO_MODEL),
    "many steps": ({"n_steps": 10**15}, "n_steps"),
    "steps of no number": ({"n_steps": NOT_A_NUMBER}, "n_steps"),
    "many environments": ({"n_envs": 10**9}, "n_steps|n_envs"),
    "a script": ({"extra.py": b""}, NO_MEMBER),
    "tensors by the name of a method": ({"predict.pth": tensors({})}, NO_MODEL),
    "variables by that of another": ({"pytorch_variables.pth": tensors(OTHERS)}, r"y\.predict"),
    "no settings": ({"data": b""}, "settings that are no JSON"),
    "settings in settings": ({"data": b"[" * 100_000}, "settings that are no JSON"),
    "settings of nothing": ({"data": b"{}"}, NO_MODEL),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_no_model_has_is_refused(genuine, change):
    changes, message = CHANGES[change]
    is_member = all(isinstance(value, bytes) for value in changes.values())
    members = {**genuine, **changes} if is_member else with_settings(genuine, **changes)
    with pytest.raises(UnsafeFileError, match=message):
        load(members)


def test_a_model_has_settings_and_tensors(genuine):
    for missing in ("data", "pth"):
        members = {name: held for name, held in genuine.items() if not name.endswith(missing)}
        with pytest.raises(UnsafeFileError, match="lacks parts that a model has"):
            read_model(zip_of(members))


BIAS = "action_net.bias"


def test_tensors_that_such_a_model_does_not_have_are_refused(genuine):
    held = th.load(io.BytesIO(genuine["policy.pth"]), weights_only=True)
    # No number, complex, of another shape, a list.
    for wrong in (held[BIAS] * th.nan, held[BIAS] + 1j, th.zeros(3), [0.0]):
        with pytest.raises(UnsafeFileError) as refusal:
            load({**genuine, "policy.pth": tensors({**held, BIAS: wrong})})
        assert str(refusal.value).isprintable()


def test_what_is_no_tensor_is_told_in_one_line_of_ours(genuine, tmp_path):
    """PyTorch explains in several lines how to have the code run after all."""
    mark, key = tmp_path / "mark", "archive/data.pkl"
    deep = b"\x80\x02" + b"]" * 5000 + b"a" * 4999 + b"."
    files = {
        "a call": (tensors(Attack(mark)), "holds posix.mkdir, which may not stand in such a file"),
        "a pickle": (pickle.dumps(Attack(mark)), "is no whole zip"),
        "signs that a terminal obeys": (zip_of({key: b"ca\x1b[2J\nb\n."}), "holds"),
        "a cut one": (tensors({BIAS: th.zeros(1)})[:-30], "is no whole zip"),
        "lists in lists": (zip_of({key: deep}), "is nested more than 40 deep"),
        "a tensor of nothing": (tensors({"x": th.ones(1, device="meta")}), "may not stand"),
    }
    for what, (content, told) in files.items():
        with pytest.raises(UnsafeFileError) as refused:
            load({**genuine, "policy.pth": content})
        assert told in str(refused.value), what
        assert str(refused.value).isprintable(), what
        assert not mark.exists()


def test_what_is_no_regular_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "model.zip")
    for path in (tmp_path / "model.zip", Path("/dev/zero"), tmp_path):
        with pytest.raises(UnsafeFileError, match="no regular file"):
            load_model(PPO, path)


def test_a_buffer_has_its_rows_in_the_file():
    agent = DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu")
    agent.replay_buffer.buffer_size = 10**9
    content = io.BytesIO(pickle.dumps(agent.replay_buffer))
    with pytest.raises(UnsafeFileError, match="wrong observations"):
        load_replay_buffer(agent, content)


def peak_and_answer(load, *args):
    """Bytes that a call takes at its peak, in its own process; and the refusal it ends with."""
    there, here = os.pipe()
    child = os.fork()
    if child == 0:
        Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
        before, answer = memory("VmRSS"), ""
        try:
            load(*args)
        except UnsafeFileError as error:
            answer = str(error)
        except BaseException as error:  # noqa: BLE001  # nothing else may come of it
            answer = f"{type(error).__name__}\n"
        os.write(here, json.dumps([memory("VmHWM") - before, answer]).encode())
        os._exit(0)
    os.close(here)
    with os.fdopen(there) as answers:
        peak, answer = json.load(answers)
    os.waitpid(child, 0)
    return peak, answer


def memory(field):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith(field))


def check_peak(attack, content, load):
    peak, answer = peak_and_answer(load, io.BytesIO(content))
    assert "\n" not in answer, (attack, answer)
    # The file, and five times the file and 64 MB; and what a process takes of itself.
    assert peak < 6 * len(content) + 80 * MB, (attack, answer)
    return answer


SIZE, BYTES = struct.pack("<I", 4 * MB), name("numpy", "dtype") + text("u1") + b"\x89\x88\x87R"
# Ten bytes make an array of four megabytes, from what is in the memo before.
MEMO = b"B" + SIZE + bytes(4 * MB) + b"\x940" + BYTES + b"\x940" + FROM_BUFFER + b"\x940"
ARRAY = b"h\x02(h\x00h\x01J" + SIZE + text("C") + b"tR"
M61 = (1 << 61) - 1  # whole numbers that it divides have one hash
LONGS = b"".join(b"\x8a\x0f" + (M61 * i).to_bytes(15, "little") + b"N" for i in range(1, 20_000))
BOMBS = {
    "one text in many arrays": MEMO + b"](" + ARRAY * 150 + b"e.",
    "many lists": b"](" + b"]" * 4_000_000 + b"e.",
    "many places of the memo": b"N" + b"\x94" * 4_000_000 + b".",
    "many calls": DEQUE + b"\x940](" + b"h\x00)R" * 1_000_000 + b"e.",
    "a wide text": b"X" + struct.pack("<I", 16 * MB + 4) + b"a" * 16 * MB + b"\xf0\x9f\x98\x80.",
    "bytes that are not there": b"\x96" + (8 << 30).to_bytes(8, "little") + b".",
    "keys of one hash": b"}(" + LONGS + b"u.",
    "a wide text of protocol 0": b"V" + b"a" * 16 * MB + b"\\U0001f600\n.",
    "many sets": b"](" + b"\x8f" * 4_000_000 + b"e.",
    "many dictionaries of protocol 0": b"](" + b"(d" * 2_000_000 + b"e.",
    "a value that is huge once it is written out": LAYERS + TOP + b".",
    # What reading them takes just fits the budget.
    "dictionaries that just fit": b"](" + b"}K\x01Ns" * 90_000 + b"e.",
    "calls that just fit": DEQUE + b"\x940](" + b"h\x00)R" * 130_000 + b"e.",
    "a list in lists in lists":
        b"](" + b"N" * 3000 + b"e\x940](" + b"h\x00" * 3000 + b"e\x940](" + b"h\x01" * 3000 + b"e.",
}  # fmt: skip


@pytest.mark.parametrize("attack", BOMBS)
def test_memory_is_in_proportion_to_statistics(attack):
    content = START + BOMBS[attack]
    assert check_peak(attack, content, lambda stream: read_normalization(stream.read()))


def view(n_stored, said, offset, size, stride, kind="Float", key=text("0")):  # noqa: B008
    """A file of one tensor, as PyTorch would write it if it were true."""
    said, offset, size, stride = (b"J" + struct.pack("<i", n) for n in (said, offset, size, stride))
    storage = b"(" + text("storage") + f"ctorch\n{kind}Storage\n".encode() + key
    storage += text("cpu") + said + b"tQ" + offset + size + b"\x85" + stride + b"\x85"
    tensor = b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"\x89}tR."
    pickled = b"\x80\x02Nq\x000" + b"".join(b"h%ch%c\x86q%c0" % (i, i, i + 1) for i in range(32))
    return zip_of({"archive/data.pkl": pickled + tensor, "archive/data/0": bytes(4 * n_stored)})


# Stored numbers, those it says it has, and its place, size and stride.
VIEWS = {
    "no stride": view(1, 1, 0, 10**9, 0),
    "a storage that is not there": view(1, 10**9, 0, 10**9, 1),
    "a tensor beyond its storage": view(1, 1, 0, 10**9, 1),
    "a place beyond its storage": view(1, 1, 10**9, 1, 1),
    "a negative size": view(1, 1, 0, -1, 1),
    "a kind that is not known": view(1, 1, 0, 1, 1, kind="Evil"),
    "a record elsewhere": view(1, 1, 0, 1, 1, key=text("../x")),
    "a key that is huge once it is written out": view(1, 1, 0, 1, 1, key=b"h\x20"),
}


def test_storages_that_pytorch_does_not_write_are_refused():
    assert load_tensors(view(4, 4, 1, 2, 2)).tolist() == [0, 0]
    for attack, content in VIEWS.items():
        assert check_peak(attack, content, lambda stream: load_tensors(stream.read())), attack


def stream(content):
    """A file as PyTorch wrote it before version 1.6: five pickles, then sizes and numbers."""
    th.save(content, file := io.BytesIO(), _use_new_zipfile_serialization=False)
    return file.getvalue()


def test_streams_of_tensors_are_read_or_refused():
    shared = th.arange(6.0)
    held = {"a": shared[::2], "b": [shared.view(2, 3)], "c": th.ones(2, dtype=th.uint8), "d": {}}
    assert str(load_tensors(stream(held))) == str(held)
    whole = stream({"x": th.ones(5)})
    start, numbers = whole[:-28], whole[-20:]  # and eight bytes of their size
    for content in (
        *(start + size.to_bytes(8, "little") + numbers for size in (0, 4, 6, 10**18, 2**64 - 1)),
        *(whole[:-1], start, whole[:15], stream({})[:15] + pickle.dumps(Attack("mark"))),
        start[: start.rindex(b"]")] + b"N.",
        start.replace(b"]q\0", b"]q\0}a") + whole[-28:],
        whole.replace(b"FloatStorage", b"EvilyStorage"),
    ):
        assert check_peak("a stream", content, lambda file: load_tensors(file.read()))


def hostile_zips(genuine):
    """Each attack as a zip of a model."""
    for held in ("[" + "[]," * 3_000_000 + "[]]", "[" + "1," * 5_000_000 + "1]"):
        data = genuine["data"].decode().rstrip()[:-1] + f', "invented": {held}}}'
        yield "JSON", zip_of({**genuine, "data": data}, zipfile.ZIP_DEFLATED)
    for member in ("policy.pth", "policy.optimizer.pth", "pytorch_variables.pth"):
        yield f"a lie in {member}", zip_of({**genuine, member: VIEWS["no stride"]})
    features = {"features_extractor_kwargs": {"features_dim": 10**9}}
    for kwargs in ({"net_arch": [30_000, 30_000]}, features):
        yield "networks", zip_of(with_settings(genuine, policy_kwargs=kwargs))
    yield "many members", zip_of({**genuine, **{f"x{i}": b"" for i in range(30_000)}})
    inflated = zip_of({**genuine, "a.pth": bytes(400 * MB)}, zipfile.ZIP_DEFLATED)
    yield "a member that inflates", inflated
    size = (400 * MB).to_bytes(4, "little")
    yield "a member that says less than it inflates to", inflated.replace(size, b"\x0a\0\0\0")


def test_memory_is_in_proportion_to_a_models_file(genuine, tmp_path):
    for attack, content in hostile_zips(genuine):
        path = tmp_path / "model.zip"
        path.write_bytes(content)
        assert check_peak(attack, content, partial(load_model, PPO)), attack
        check_peak(attack, content, lambda stream: read_model(stream.read()))
        check_peak(attack, content, lambda stream: inspect_model(path))  # noqa: B023


def test_a_large_genuine_file_is_loaded_within_its_budget():
    kwargs = {"policy_kwargs": {"net_arch": [1500, 1500]}}
    content = zip_of(members_of(PPO("MlpPolicy", "CartPole-v1", device="cpu", **kwargs)))
    assert len(content) > 15 * MB
    assert check_peak("genuine", content, partial(load_model, PPO, device="cpu")) == ""


KEYS = st.text(max_size=5) | st.integers(-(2**60), 2**60)
VALUES = st.recursive(
    KEYS | st.binary(max_size=5) | st.none() | st.booleans() | st.floats(allow_nan=False),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(KEYS, inner, max_size=4)
    ),
    max_leaves=20,
)


@settings(max_examples=30)
@given(VALUES, st.integers(0, 5))
def test_plain_data_comes_out_as_it_went_in(value, protocol):
    assert read_pickle(pickle.dumps(value, protocol)) == value


@given(VALUES, st.data())
def test_cut_off_pickles_are_refused(value, data):
    whole = pickle.dumps(value)
    length = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(UnsafeFileError):
        read_pickle(whole[:length])


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 2, 0)])
def test_arrays_come_out_as_they_went_in(axes):
    """Pictures with their channels in front are views with the axes in another order."""
    array = np.arange(24, dtype=np.uint8).reshape(2, 3, 4).transpose(axes)
    found = read_pickle(pickle.dumps(array))
    assert (found.dtype, found.tolist()) == (array.dtype, array.tolist())

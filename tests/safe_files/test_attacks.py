"""Pickles and zips that would run code, hide methods, or fill the memory: all are refused."""

import base64
import io
import json
import os
import pickle
import tracemalloc
import warnings
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.utils import ConstantSchedule

from safe_files import UnsafeFileError, inspect_model, load_model, load_replay_buffer
from safe_files.buffers_and_statistics import read_normalization
from safe_files.known_objects import load_tensors, read_pickle

UTILS = "stable_baselines3.common.utils"
START = b"\x80\x04"


def text(value):
    return b"\x8c" + bytes([len(value)]) + value.encode()


def name(module, qualname):
    return text(module) + text(qualname) + b"\x93"


def shared_tuples(depth):
    """A tuple of a tuple of ... that has 2**depth leaves, and takes as many bytes as layers."""
    layers = b"N\x940" + b"".join(b"h%ch%c\x86\x940" % (i, i) for i in range(depth))
    return layers, b"h%c" % depth


LAYERS, TOP = shared_tuples(40)
DEQUE = name("collections", "deque")
CONSTANT = name(UTILS, "ConstantSchedule")
FLOAT_SCHEDULE = name(UTILS, "FloatSchedule")
RELU = name("torch.nn.modules.activation", "ReLU")


def space(kind, **state):
    module, _, cls = kind.partition(".")
    fields = b"".join(text(key) + value for key, value in state.items())
    return name(f"gymnasium.spaces.{module}", cls) + b")\x81}(" + fields + b"ub"


def with_state(maker, key, value):
    """A new object whose state has one attribute."""
    return maker + b")\x81}" + text(key) + value + b"sb"


# Instructions of protocol 4, between its beginning and its end.
INSTRUCTIONS = {
    "a call of the system": name("os", "system") + text("true") + b"\x85R",
    "getattr": name("builtins", "getattr"),
    "a way through attributes": name(UTILS, "FloatSchedule.__init__.__globals__"),
    "the state of a class, by slots": CONSTANT + b"N}" + text("__call__") + DEQUE + b"s\x86b",
    "an object that is called": CONSTANT + b")R)R",
    "an attribute that is no setting": with_state(CONSTANT, "__class__", b"K\x01"),
    "a schedule that is a class": with_state(FLOAT_SCHEDULE, "value_schedule", RELU),
    "lists in lists": b"]" * 5000 + b"a" * 4999,
    "an array of gigabytes": name("numpy._core.multiarray", "_reconstruct")
    + name("numpy", "ndarray") + b"J\xff\xff\xff\x7f\x85C\x01b\x87R",
    "a key whose hash takes for ever": LAYERS + b"}" + TOP + b"K\x01s",
    "a value that is huge once it is written out": LAYERS + TOP,
    # Calls of what calls return, and states of what is no new object.
    "a call of a call": DEQUE + b")R)R",
    # Places of the stack and of the memo.
    "an object among its own items": DEQUE + b")R\x94h\x00a",
    "a space of many values":
        space("discrete.Discrete", n=b"\x8a\x0c" + b"\x7f" * 12, start=b"K\0"),
}  # fmt: skip
# Each is read by everything that reads pickles, see `loaders`.
ATTACKS = {attack: START + instructions + b"." for attack, instructions in INSTRUCTIONS.items()} | {
    "a call of the system in protocol 0": b"cos\nsystem\n(S'true'\ntR.",
    "an array of objects": pickle.dumps(np.array([print], dtype=object)),
    "a schedule that is no number": pickle.dumps(ConstantSchedule(float("nan"))),
}


@pytest.fixture(scope="module")
def loaders(genuine):
    """What reads pickles: by themselves, as statistics, as a buffer, and in the zip of a model."""
    agent = DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu")

    def in_zip(content):
        held = {":type:": "x", ":serialized:": base64.b64encode(content).decode()}
        return io.BytesIO(zip_of(with_settings(genuine, invented=held)))

    return {
        "alone": read_pickle,
        "statistics": read_normalization,
        "a buffer": lambda content: load_replay_buffer(agent, io.BytesIO(content)),
        "a zip": lambda content: load_model(PPO, in_zip(content)),
    }


@pytest.mark.parametrize("attack", ATTACKS)
def test_attacks_by_pickle_are_refused(attack, loaders):
    for loader, load in loaders.items():
        tracemalloc.start()
        try:
            with pytest.raises(UnsafeFileError) as refusal:
                load(ATTACKS[attack])
            assert tracemalloc.get_traced_memory()[1] < 50e6, loader
        finally:
            tracemalloc.stop()
        assert str(refusal.value).isprintable(), loader


@pytest.fixture(scope="module")
def genuine():
    """The members of a genuine zip."""
    kwargs = {"policy_kwargs": {"net_arch": [4]}, "device": "cpu"}
    return members_of(PPO("MlpPolicy", "CartPole-v1", **kwargs))


def members_of(agent):
    content = io.BytesIO()
    agent.save(content)
    with zipfile.ZipFile(content) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def load(members, algorithm=PPO):
    return load_model(algorithm, io.BytesIO(zip_of(members)))


def with_settings(genuine, **changes):
    return {**genuine, "data": json.dumps({**json.loads(genuine["data"]), **changes}).encode()}


def pickled(value):
    return {":type:": "x", ":serialized:": base64.b64encode(pickle.dumps(value)).decode()}


class Attack:
    """Leaves a mark where it is unpickled."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.mkdir, (self.mark,)


def test_no_pickle_in_the_settings_is_run(genuine, tmp_path):
    mark = tmp_path / "mark"
    assert isinstance(load(genuine), PPO)
    for key in ("policy_class", "invented", "learning_rate", "clip_range", "algorithm"):
        with pytest.raises(UnsafeFileError, match=key) as refusal:
            load(with_settings(genuine, **{key: pickled(Attack(mark))}))
        assert refusal.value.key == key
    # What the reader decides is not even read.
    for key in ("env", "_logger", "device", "_vec_normalize_env", "lr_schedule"):
        assert isinstance(load(with_settings(genuine, **{key: pickled(Attack(mark))})), PPO)
    assert not mark.exists()


def tensors(content, **options):
    file = io.BytesIO()
    th.save(content, file, **options)
    return file.getvalue()


NO_ATTRIBUTE, NO_MEMBER = "no attribute of a model", "which no model file has"
# What is changed in the settings, or put in place of a member; and what the refusal says.
CHANGES = {
    "a method": ({"predict": 1}, NO_ATTRIBUTE),
    "wide networks": ({"policy_kwargs": {"net_arch": [10**6, 10**6]}}, "memory"),
    "layers below zero": ({"policy_kwargs": {"net_arch": [-5]}}, "holds no such model"),
    "many steps": ({"n_steps": 10**15}, "n_steps"),
    "many environments": ({"n_envs": 10**9}, "n_steps|n_envs"),
    "a script": ({"extra.py": b""}, NO_MEMBER),
    "a way out": ({"../escaped.pth": b""}, NO_MEMBER),
    "tensors by the name of a method": ({"predict.pth": b""}, NO_MEMBER),
    "settings in settings": ({"data": b"[" * 100_000}, "settings that are no JSON"),
    "settings of nothing": ({"data": b"{}"}, "does not say its policy's class"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_no_model_has_is_refused(genuine, change):
    changes, message = CHANGES[change]
    is_member = all(isinstance(value, bytes) for value in changes.values())
    members = {**genuine, **changes} if is_member else with_settings(genuine, **changes)
    with pytest.raises(UnsafeFileError, match=message) as refusal:
        load(members)
    named = {None, "n_steps", "policy_class", *changes}
    assert refusal.value.key in named - {"policy_kwargs"}


@pytest.fixture(scope="module")
def trained():
    """The members of the zip of a SAC agent, whose optimizers have seen something."""
    settings = {"policy_kwargs": {"net_arch": [4]}, "learning_starts": 4, "batch_size": 4}
    return members_of(SAC("MlpPolicy", "Pendulum-v1", device="cpu", **settings).learn(6))


BIAS = "actor.mu.bias"
WRONG_TENSORS = {
    "a weight that is no number": ("policy.pth", lambda held: held[BIAS].fill_(th.nan)),
    "a weight of another shape": ("policy.pth", lambda held: held.update({BIAS: th.zeros(2)})),
    "an average of another kind": (
        "actor.optimizer.pth",
        lambda held: held["state"][0].update(exp_avg=held["state"][0]["exp_avg"].double()),
    ),
}


@pytest.mark.parametrize("wrong", WRONG_TENSORS)
def test_tensors_that_such_a_model_does_not_have_are_refused(trained, wrong):
    assert isinstance(load(trained, SAC), SAC)
    member, change = WRONG_TENSORS[wrong]
    held = th.load(io.BytesIO(trained[member]), weights_only=True)
    change(held)
    reason = member.replace(".", r"\.") + "|size mismatch"
    with pytest.raises(UnsafeFileError, match=reason):
        load({**trained, member: tensors(held)}, SAC)


def not_tensors(mark):
    """Files that stand in the place of tensors, and what is said of each."""
    zeros, old = tensors({BIAS: th.zeros(1)}), {"_use_new_zipfile_serialization": False}
    deflated = {"archive/data/0": bytes(10**6)}
    begin, may_not = "holds tensors that cannot be read: ", ", which may not stand in such a file"
    no_zip = f"{begin}is no whole zip"
    return {
        "a call": (tensors(Attack(mark)), f"{begin}holds posix.mkdir{may_not}"),
        "a call in the old format": (tensors(Attack(mark), **old), no_zip),
        "a pickle": (pickle.dumps(Attack(mark)), no_zip),
        "a cut one": (zeros[:-30], no_zip),
        "one that was deflated": (zip_of(deflated, zipfile.ZIP_DEFLATED), "compressed"),
    }


@pytest.mark.filterwarnings("always")
def test_what_is_no_tensor_is_told_in_one_line_of_ours(genuine, tmp_path, recwarn):
    """PyTorch warns, and explains in several lines how to have the code run after all."""
    mark = tmp_path / "mark"
    for what, (content, told) in not_tensors(mark).items():
        recwarn.clear()
        with pytest.raises(UnsafeFileError) as refused:
            load({**genuine, "policy.pth": content})
        line = str(refused.value)
        assert told in line, what
        assert line.isprintable(), what
        assert "weights_only" not in line.lower().replace(" ", "_"), what
        assert not recwarn.list, what
        assert not mark.exists()


def test_a_zip_with_a_member_twice_or_a_bomb_in_a_bomb_is_refused(genuine):
    two = io.BytesIO()
    with zipfile.ZipFile(two, "w") as archive, warnings.catch_warnings(action="ignore"):
        for member, held in [*genuine.items(), ("policy.pth", b"another")]:
            archive.writestr(member, held)
    bomb = zip_of({"archive/data.pkl": bytes(100 * MB)}, zipfile.ZIP_DEFLATED)
    nested = zip_of({**genuine, "policy.pth": bomb}, zipfile.ZIP_DEFLATED)
    for content in (two.getvalue(), nested):
        with pytest.raises(UnsafeFileError):
            load_model(PPO, io.BytesIO(content))


def test_what_is_no_regular_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "model.zip")
    for path in (tmp_path / "model.zip", Path("/dev/zero"), tmp_path):
        with pytest.raises(UnsafeFileError, match="no regular file"):
            load_model(PPO, path)


# --- memory in proportion to the file ------------------------------------------------------------

MB = 1 << 20


def long_bytes(n):
    return b"B" + n.to_bytes(4, "little") + bytes(n)


def shared_array(n):
    """Ten bytes that make an array of ``n`` bytes, from what is in the memo before; and that."""
    kind = name("numpy", "dtype") + text("u1") + b"\x89\x88\x87R\x940"
    make = name("numpy._core.numeric", "_frombuffer")
    memo = long_bytes(n) + b"\x940" + kind + make + b"\x940"
    size = b"J" + n.to_bytes(4, "little")
    return memo, b"h\x02(h\x00h\x01" + size + text("C") + b"tR"


ARRAY_MEMO, ARRAY = shared_array(4 * MB)


M61 = (1 << 61) - 1  # whole numbers that it divides have one hash
LONGS = b"".join(b"\x8a\x0f" + (M61 * i).to_bytes(15, "little") + b"N" for i in range(1, 20_000))
BOMBS = {
    "one text in many arrays": ARRAY_MEMO + b"](" + ARRAY * 150 + b"e.",
    "many lists": b"](" + b"]" * 4_000_000 + b"e.",
    "a wide text":
        b"X" + (16 * MB + 4).to_bytes(4, "little") + b"a" * 16 * MB + b"\xf0\x9f\x98\x80.",
    "keys of one hash": b"}(" + LONGS + b"u.",
    # What reading them takes just fits the budget.
    "lists that just fit": b"](" + b"](Ne" * 230_000 + b"e.",
}  # fmt: skip


def view(n_stored, said, offset, shape, strides):
    """A file of one tensor of float32, as PyTorch would write it if it were true."""
    pickled = io.BytesIO()

    class Storage:
        """What PyTorch's pickles refer to by an id."""

    class Tensor:
        def __reduce__(self):
            make = th._utils._rebuild_tensor_v2
            return make, (Storage(), offset, shape, strides, False, {})

    class Pickler(pickle.Pickler):
        def persistent_id(self, value):
            is_storage = type(value) is Storage
            return ("storage", th.FloatStorage, "0", "cpu", said) if is_storage else None

    Pickler(pickled, 2).dump({"log_std": Tensor()})
    return zip_of({"archive/data.pkl": pickled.getvalue(), "archive/data/0": bytes(4 * n_stored)})


def zip_of(members, method=zipfile.ZIP_STORED):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", method) as archive:
        for member, held in members.items():
            archive.writestr(member, held)
    return content.getvalue()


# Stored numbers, those it says it has, and its place, shape and strides.
VIEWS = {
    "no stride at all": (1, 1, 0, (10**15,), (0,)),
    "a view that overlaps": (10**6, 10**6, 0, (1000, 900_000), (1, 1)),
    "a storage that is not there": (1, 10**9, 0, (10**9,), (1,)),
    "a tensor beyond its storage": (1, 1, 0, (10**9,), (1,)),
}


@pytest.mark.parametrize("lie", VIEWS)
def test_tensors_that_are_not_there_or_overlap_are_refused(lie):
    assert check_peak(lie, view(*VIEWS[lie]), lambda stream: load_tensors(stream.read()))


NETWORKS = {
    "wide layers": {"net_arch": [30_000, 30_000]},
    "features": {"features_extractor_kwargs": {"features_dim": 10**9}, "net_arch": [10**6, 10**6]},
}


def hostile_zips(genuine):
    """Each attack as a zip of a model."""
    # All are read as statistics below, and one as the settings of a model too.
    content = base64.b64encode(START + BOMBS["one text in many arrays"]).decode()
    changed = with_settings(genuine, invented={":type:": "x", ":serialized:": content})
    yield "one text in many arrays", zip_of(changed, zipfile.ZIP_DEFLATED)
    data = genuine["data"].decode().rstrip()[:-1]
    data += f', "invented": [{"[]," * 3_000_000}[]]}}'
    yield "lists in JSON", zip_of({**genuine, "data": data}, zipfile.ZIP_DEFLATED)
    far = view(*VIEWS["no stride at all"])
    yield "a lie in tensors", zip_of({**genuine, "policy.pth": far})
    for wish, kwargs in NETWORKS.items():
        yield wish, zip_of(with_settings(genuine, policy_kwargs=kwargs))
    yield "many members", zip_of({**genuine, **{f"x{i}": b"" for i in range(30_000)}})
    inflated = zip_of({**genuine, "tensors.pth": bytes(120 * MB)}, zipfile.ZIP_DEFLATED)
    yield "a member that inflates", inflated
    size = (120 * MB).to_bytes(4, "little")
    yield "a member that says less than it inflates to", inflated.replace(size, b"\x0a\0\0\0")


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
    # The file, and four times the file and 64 MB; and what a process takes of itself.
    assert peak < 5 * len(content) + 80 * MB, (attack, answer)
    return answer


def test_memory_is_in_proportion_to_a_models_file(genuine, tmp_path):
    for attack, content in hostile_zips(genuine):
        path = tmp_path / "model.zip"
        path.write_bytes(content)
        assert check_peak(attack, content, partial(load_model, PPO)), attack
        check_peak(attack, content, lambda stream: inspect_model(path))  # noqa: B023


@pytest.mark.parametrize("attack", BOMBS)
def test_memory_is_in_proportion_to_statistics(attack):
    content = START + BOMBS[attack]
    assert check_peak(attack, content, lambda stream: read_normalization(stream.read()))


def test_a_large_genuine_file_is_loaded_within_its_budget(tmp_path):
    kwargs = {"policy_kwargs": {"net_arch": [1500, 1500]}}
    model = PPO("MlpPolicy", "CartPole-v1", device="cpu", **kwargs)
    model.save(tmp_path / "model.zip")
    content = (tmp_path / "model.zip").read_bytes()
    assert len(content) > 15 * MB
    assert check_peak("genuine", content, partial(load_model, PPO, device="cpu")) == ""

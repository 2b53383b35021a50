"""Pickles and zips that would run code, hide methods, or fill the memory: all are refused."""

import base64
import io
import json
import os
import pickle
import pickletools
import struct
import tracemalloc
import warnings
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN, PPO, SAC, HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.utils import ConstantSchedule

from rl_yardstick.safe_files import UnsafeFileError, inspect_model, load_model, load_replay_buffer
from rl_yardstick.safe_files.archives import first_look
from rl_yardstick.safe_files.buffers_and_statistics import read_normalization
from rl_yardstick.safe_files.known_objects import load_tensors, read_pickle
from rl_yardstick.safe_files.pickles import PRICES

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
FROM_BUFFER = name("numpy._core.numeric", "_frombuffer")
FLOATS = name("numpy", "dtype") + text("f8") + b"\x89\x88\x87R"
MEGABYTE = bytes(10**6 - 1)
NAN = b"G\x7f\xf8" + bytes(6)
SHORT_LAYERS, SHORT_TOP = shared_tuples(32)


def array(data, shape):
    """An array of float64 with a shape that is pickled already."""
    return FROM_BUFFER + b"(C" + bytes([len(data)]) + data + FLOATS + shape + text("C") + b"tR"


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
    "a huge index of the memo": b"Nr\xff\xff\xff\x0f0h\x01",
    "an array of gigabytes": name("numpy._core.multiarray", "_reconstruct")
    + name("numpy", "ndarray") + b"J\xff\xff\xff\x7f\x85C\x01b\x87R",
    "a key whose hash takes for ever": LAYERS + b"}" + TOP + b"K\x01s",
    "a value that is huge once it is written out": LAYERS + TOP,
    "a length that is not there": b"\x8e\xff\xff\xff\xff\xff\xff\xff\x7f",
    "a schedule of a huge number": with_state(CONSTANT, "val", b"\x8a\xff" + b"\x7f" * 255),
    # Calls of what calls return, and states of what is no new object.
    "a call of a call": DEQUE + b")R)R",
    "a call of a call that is huge once it is written out":
        SHORT_LAYERS + DEQUE + SHORT_TOP + b"\x85R)R",
    "two states": CONSTANT + b")\x81}b}b",
    "the state of a name": name("builtins", "int") + b"}b",
    "a state that is its own object":
        FLOAT_SCHEDULE + b")\x81\x94}" + text("value_schedule") + b"h\x00sb",
    # Places of the stack and of the memo.
    "an end before the beginning": b"0000",
    "an item of a name": name("os", "environ") + b"Na",
    "a member of an object": DEQUE + b")R(K\x01\x90",
    "a place of the memo that is empty": b"h\x07",
    "an object among its own items": DEQUE + b")R\x94h\x00a",
    "an object in its own argument": b"]\x94" + DEQUE + b"h\x00\x85R\x94a",
    # Keys and members whose hash is not theirs alone, or takes for ever.
    "a key that is an object": b"}" + DEQUE + b")RNs",
    "members that are tuples": SHORT_LAYERS + b"\x8f(" + SHORT_TOP + b"\x90",
    "frozen members that are tuples": SHORT_LAYERS + b"(" + SHORT_TOP + b"\x91",
    # The last byte makes it as long as it says.
    "a long number of a megabyte": b"\x8b" + struct.pack("<i", 10**6) + MEGABYTE + b"\x7f",
    "a long number of -1 bytes": b"\x8b\xff\xff\xff\xff",
    "a frame without an end": b"\x95" + b"\xff" * 8 + b"N",
    "a frame in a frame": b"\x95" + struct.pack("<Q", 20) + b"\x95" + bytes(20) + b"N",
    # Sizes that are no numbers, or too large.
    "an array of no number": array(bytes(8), NAN + b"\x85"),
    "an array of -1 numbers": array(bytes(8), b"J\xff\xff\xff\xff\x85"),
    "an array of 33 dimensions": array(bytes(8), b"(" + b"K\x01" * 33 + b"t"),
    "a space of many values":
        space("discrete.Discrete", n=b"\x8a\x0c" + b"\x7f" * 12, start=b"K\0"),
    "a space of no number of values": space("multi_binary.MultiBinary", n=NAN),
    "a deque of a length below 0": DEQUE + b")J\xfb\xff\xff\xff\x86R",
}  # fmt: skip
# Each is read by everything that reads pickles, see `loaders`.
ATTACKS = {attack: START + instructions + b"." for attack, instructions in INSTRUCTIONS.items()} | {
    "a call of the system in protocol 0": b"cos\nsystem\n(S'true'\ntR.",
    "an array of objects": pickle.dumps(np.array([print], dtype=object)),
    "a whole number of thousands of digits": pickle.dumps(10**5000),
    "an infinite schedule": pickle.dumps(ConstantSchedule(float("inf"))),
    "a schedule that is no number": pickle.dumps(ConstantSchedule(float("nan"))),
    "protocol 255": b"\x80\xff.",
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
    assert ConstantSchedule(0.5)(1.0) == 0.5


def test_no_other_instruction_makes_or_fetches_anything():
    others = {op.name for op in pickletools.opcodes} - PRICES.keys()
    assert others >= {"GLOBAL", "INST", "OBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4"}
    assert others >= {"PERSID", "BINPERSID", "NEXT_BUFFER", "READONLY_BUFFER", "INT", "LONG"}


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


NOT_A_NUMBER = float("nan")
NO_ATTRIBUTE, NO_MEMBER = "no attribute of a model", "which no model file has"
# What is changed in the settings, or put in place of a member; and what the refusal says.
CHANGES = {
    "a method": ({"predict": 1}, NO_ATTRIBUTE),
    "a class": ({"__class__": 1}, NO_ATTRIBUTE),
    "wide networks": ({"policy_kwargs": {"net_arch": [10**6, 10**6]}}, "memory"),
    "layers of no number": ({"policy_kwargs": {"net_arch": [NOT_A_NUMBER]}}, "holds no such model"),
    "layers below zero": ({"policy_kwargs": {"net_arch": [-5]}}, "holds no such model"),
    "many steps": ({"n_steps": 10**15}, "n_steps"),
    "steps below zero": ({"n_steps": -1}, "n_steps"),
    "steps of no number": ({"n_steps": NOT_A_NUMBER}, "n_steps"),
    "many environments": ({"n_envs": 10**9}, "n_steps|n_envs"),
    "a script": ({"extra.py": b""}, NO_MEMBER),
    "a way out": ({"../escaped.pth": b""}, NO_MEMBER),
    "tensors by the name of a method": ({"predict.pth": b""}, NO_MEMBER),
    "variables by that of another": (
        {"pytorch_variables.pth": tensors({"policy.predict": th.zeros(1)})},
        r"policy\.predict",
    ),
    "no settings": ({"data": b""}, "settings that are no JSON"),
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


def test_a_model_has_settings_and_tensors_and_may_have_more_of_these(genuine):
    without = {name: held for name, held in genuine.items() if name != "data"}
    with pytest.raises(UnsafeFileError, match="lacks its settings"):
        load(without)
    for members in (without, {"data": genuine["data"]}):
        with pytest.raises(UnsafeFileError, match="lacks parts that a model has"):
            first_look(zip_of(members))
    assert first_look(zip_of({**genuine, "my_own.pth": genuine["policy.pth"]}))["n_steps"] == 2048
    with pytest.raises(UnsafeFileError, match="no model file has"):
        first_look(zip_of({**genuine, "my own.pth": genuine["policy.pth"]}))


def test_an_environment_id_in_the_settings_imports_nothing(genuine, tmp_path):
    model = load(with_settings(genuine, env="this:Zen-v0", tensorboard_log=str(tmp_path / "log")))
    assert model.env is model.tensorboard_log is None


def changed_tensor(content, change):
    """The file of tensors after `change` had its way with what it holds."""
    held = th.load(io.BytesIO(content), weights_only=True)
    change(held)
    return tensors(held)


@pytest.fixture(scope="module")
def trained():
    """The members of the zip of a SAC agent, whose optimizers have seen something."""
    settings = {"policy_kwargs": {"net_arch": [4]}, "learning_starts": 4, "batch_size": 4}
    return members_of(SAC("MlpPolicy", "Pendulum-v1", device="cpu", **settings).learn(6))


BIAS, ACTOR = "actor.mu.bias", "actor.optimizer.pth"


def weight(change):
    """Something is done to one weight."""
    return "policy.pth", lambda held: held.update({BIAS: change(held[BIAS])})


def average(change, member=ACTOR):
    """Something is done to what an optimizer remembers of one weight."""
    return member, lambda held: change(held["state"][0])


def group(member=ACTOR, **settings):
    """An optimizer has other settings."""
    return member, lambda held: held["param_groups"][0].update(settings)


def entropy(change):
    """Something is done to the entropy coefficient."""
    key = "log_ent_coef"
    return "pytorch_variables.pth", lambda held: held.update({key: change(held[key])})


WRONG_TENSORS = {
    "a weight that is no number": weight(lambda w: w.fill_(th.nan)),
    "a weight of float64": weight(lambda w: w.double()),
    "a complex weight": weight(lambda w: w + 1j),
    "a weight of another shape": weight(lambda w: th.zeros(2)),
    "a weight that is a list": weight(lambda w: [0.0]),
    "an average of another kind": average(lambda s: s.update(exp_avg=s["exp_avg"].double())),
    "an average of another shape": average(
        lambda s: s.update(exp_avg=th.zeros(3)), "critic.optimizer.pth"
    ),
    "a count of steps that is a text": average(lambda s: s.update(step="many")),
    "averages of no parameter": (ACTOR, lambda o: o["state"].update({77: {"step": 1}})),
    "a learning rate that is a text": group(lr="fast"),
    "one beta": group(betas=(0.9,)),
    "an entropy coefficient of another kind": entropy(lambda v: v.double()),
    "several entropy coefficients": entropy(lambda v: th.zeros(3)),
}


@pytest.mark.parametrize("wrong", WRONG_TENSORS)
def test_tensors_that_such_a_model_does_not_have_are_refused(trained, wrong):
    assert isinstance(load(trained, SAC), SAC)
    member, change = WRONG_TENSORS[wrong]
    changed = {**trained, member: changed_tensor(trained[member], change)}
    reason = member.replace(".", r"\.") + "|size mismatch|holds no such model"
    with pytest.raises(UnsafeFileError, match=reason):
        load(changed, SAC)


def with_members(content, **members):
    """A file of tensors with other members, or more of them."""
    archive = zipfile.ZipFile(io.BytesIO(content))
    old = {Path(name).stem: (name, archive.read(name)) for name in archive.namelist()}
    new = {stem: (f"archive/{stem}.pkl", member) for stem, member in members.items()}
    return zip_of(dict({**old, **new}.values()))


def not_tensors(mark):
    """Files that stand in the place of tensors, and what is said of each."""
    zeros, old = tensors({BIAS: th.zeros(1)}), {"_use_new_zipfile_serialization": False}
    deflated = {"archive/data/0": bytes(10**6)}
    deep = b"\x80\x02" + b"]" * 5000 + b"a" * 4999 + b"."
    begin, may_not = "holds tensors that cannot be read: ", ", which may not stand in such a file"
    no_zip = f"{begin}is no whole zip"
    return {
        "a call": (tensors(Attack(mark)), f"{begin}holds posix.mkdir{may_not}"),
        "a call in the old format": (tensors(Attack(mark), **old), no_zip),
        "a pickle": (pickle.dumps(Attack(mark)), no_zip),
        "signs that a terminal obeys": (with_members(zeros, data=b"ca\x1b[2J\nb\n."), begin),
        "TorchScript": (with_members(zeros, constants=b""), "Missing key(s) in state_dict"),
        "a cut one": (zeros[:-30], no_zip),
        "numbers of another machine": (
            zip_of({"archive/data.pkl": b"\x80\x02}.", "archive/byteorder": b"big"}),
            f"{begin}numbers in another order of bytes",
        ),
        "one that was deflated": (zip_of(deflated, zipfile.ZIP_DEFLATED), "compressed"),
        "one of no bytes": (b"", no_zip),
        "lists in lists": (with_members(zeros, data=deep), f"{begin}is nested more than 40 deep"),
        "a tensor of nothing": (tensors({"x": th.ones(1, device="meta")}), may_not),
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


def test_a_zip_that_unpacks_out_of_proportion_is_refused(genuine, tmp_path):
    path = tmp_path / "model.zip"
    path.write_bytes(zip_of(genuine))
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("tensors.pth", bytes(80 << 20))
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    try:
        with pytest.raises(UnsafeFileError, match="would take more memory"):
            load_model(PPO, path)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


def directory(raw, member, offset, packed):
    """A zip whose list of members says something else of one of them."""
    at = raw.find(b"PK\1\2")
    while raw[at + 46 : at + 46 + len(member)] != member:
        at = raw.find(b"PK\1\2", at + 4)
    return raw[: at + offset] + packed + raw[at + offset + len(packed) :]


def odd_zips(genuine):
    """Zips that say one thing here and another there."""
    raw, policy = zip_of(genuine), b"policy.pth"
    two = io.BytesIO()
    with zipfile.ZipFile(two, "w") as archive, warnings.catch_warnings(action="ignore"):
        for member, held in [*genuine.items(), ("policy.pth", b"another")]:
            archive.writestr(member, held)
    longer = zip_of({**genuine, "policy.pth!x": b"another"})
    bomb = zip_of({"archive/data.pkl": bytes(100 * MB)}, zipfile.ZIP_DEFLATED)
    return {
        "a member twice": two.getvalue(),
        "a name with a zero in it": longer.replace(b"policy.pth!x", b"policy.pth\0x"),
        "a member at another's place": directory(raw, policy, 42, bytes(4)),
        "a smaller size": directory(raw, policy, 24, struct.pack("<L", 10)),
        "a larger size": directory(raw, policy, 24, struct.pack("<L", 1 << 31)),
        "a place behind the end": directory(raw, policy, 42, struct.pack("<L", 1 << 30)),
        "bzip2": directory(raw, policy, 10, struct.pack("<H", 12)),
        "another checksum": directory(raw, policy, 16, struct.pack("<L", 1)),
        "a bomb in a bomb": zip_of({**genuine, "policy.pth": bomb}, zipfile.ZIP_DEFLATED),
    }


def test_zips_that_contradict_themselves_are_refused(genuine):
    for oddity, content in odd_zips(genuine).items():
        assert refusal_of(content), oddity


def refusal_of(content):
    try:
        load_model(PPO, io.BytesIO(content))
    except UnsafeFileError as error:
        return str(error)


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
NOISE = "stable_baselines3.common.noise"


def noise(n):
    """A noise of ``n`` actions."""
    numbers = FROM_BUFFER + b"(" + long_bytes(8 * n) + FLOATS + b"J" + struct.pack("<i", n)
    mean = numbers + b"\x85" + text("C") + b"tR"
    fields = text("_mu") + mean + text("_sigma") + b"K\x01" + text("_dtype")
    return name(NOISE, "NormalActionNoise") + b")\x81}(" + fields + name("numpy", "float32") + b"ub"


M61 = (1 << 61) - 1  # whole numbers that it divides have one hash
LONGS = b"".join(b"\x8a\x0f" + (M61 * i).to_bytes(15, "little") + b"N" for i in range(1, 20_000))
BOMBS = {
    "one text in many arrays": ARRAY_MEMO + b"](" + ARRAY * 150 + b"e.",
    "many lists": b"](" + b"]" * 4_000_000 + b"e.",
    "many places of the memo": b"N" + b"\x94" * 4_000_000 + b".",
    "many calls": DEQUE + b"\x940](" + b"h\x00)R" * 1_000_000 + b"e.",
    "a wide text":
        b"X" + (16 * MB + 4).to_bytes(4, "little") + b"a" * 16 * MB + b"\xf0\x9f\x98\x80.",
    "bytes that are not there": b"\x96" + (8 << 30).to_bytes(8, "little") + b".",
    "keys of one hash": b"}(" + LONGS + b"u.",
    # What reading them takes just fits the budget.
    "lists that just fit": b"](" + b"](Ne" * 230_000 + b"e.",
    "calls that just fit": DEQUE + b"\x940](" + b"h\x00)R" * 140_000 + b"e.",
    "a list in lists in lists":
        b"](" + b"N" * 3000 + b"e\x940](" + b"h\x00" * 3000 + b"e\x940](" + b"h\x01" * 3000 + b"e.",
}  # fmt: skip
JSON_BOMBS = {
    "lists in JSON": "[" + "[]," * 3_000_000 + "[]]",
    "numbers in JSON": "[" + "1," * 5_000_000 + "1]",
}


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


def pickled_text(value):
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def storage(kind, key, size):
    """A storage as PyTorch's pickles refer to it, by parts that are pickled already."""
    return b"(" + pickled_text("storage") + kind + key + pickled_text("cpu") + size + b"tQ"


def file_of(pickled, record):
    """A file of tensors with one record of numbers."""
    return zip_of({"archive/data.pkl": b"\x80\x02" + pickled + b".", "archive/data/0": record})


NUMBERS = {"Byte": 1, "Char": 1, "Bool": 1, "Short": 2, "Int": 4, "Long": 8, "Half": 2} | {
    "BFloat16": 2, "Float": 4, "Double": 8, "ComplexFloat": 8, "ComplexDouble": 16
}  # fmt: skip
PATH = pickled_text("0")
FLOAT = b"ctorch\nFloatStorage\n"
OLD_LAYERS = b"Nq\x000" + b"".join(b"h%ch%c\x86q%c0" % (i, i, i + 1) for i in range(32))
REBUILT = b"ctorch._utils\n_rebuild_tensor_v2\n("
FEW = storage(FLOAT, PATH, b"K\x04")


def same_record_as_many_kinds(n):
    kinds = b""
    for kind, size in NUMBERS.items():
        named, fitting = f"ctorch\n{kind}Storage\n".encode(), b"J" + struct.pack("<i", n // size)
        kinds += REBUILT + storage(named, PATH, fitting) + b"K\x00K\x01\x85K\x01\x85\x89}tR"
    return file_of(b"](" + kinds + b"e", bytes(n))


FOUR = bytes(16)  # four numbers of float32
HUGE = b"h\x20"
LONG = b"\x8a\x08" + struct.pack("<q", 1 << 62)
STORAGES = {
    "a key that is huge once it is written out":
        file_of(OLD_LAYERS + storage(FLOAT, HUGE, b"K\x01"), bytes(4)),
    "a size that is huge once it is written out":
        file_of(OLD_LAYERS + storage(FLOAT, PATH, HUGE), bytes(4)),
    "a kind that is huge once it is written out":
        file_of(OLD_LAYERS + storage(HUGE, PATH, b"K\x01"), bytes(4)),
    "a size that is no number": file_of(storage(FLOAT, PATH, NAN), bytes(4)),
    "a storage that is no tuple": file_of(b"NQ", bytes(4)),
    "a record elsewhere": file_of(storage(FLOAT, pickled_text("../x"), b"K\x01"), bytes(4)),
    "the state of a storage": file_of(FEW + b"}b", FOUR),
    "a stride that is no number":
        file_of(REBUILT + FEW + b"K\x00K\x02\x85" + NAN + b"\x85\x89}tR", FOUR),
    "a size that has no end":
        file_of(REBUILT + FEW + b"K\x00" + LONG + b"\x85K\x01\x85\x89}tR", FOUR),
    "a record under two names": zip_of({
        "archive/data.pkl": b"\x80\x02" + FEW + b".",
        "archive/data/0": FOUR,
        "other/data/0": b"\0\0\x80?" * 4,
    }),
    "one record as many kinds of numbers": same_record_as_many_kinds(48 * MB),
}  # fmt: skip


# Stored numbers, those it says it has, and its place, shape and strides.
VIEWS = {
    "no stride": (1, 1, 0, (10**9,), (0,)),
    "no stride at all": (1, 1, 0, (10**15,), (0,)),
    "a view that overlaps": (10**6, 10**6, 0, (1000, 900_000), (1, 1)),
    "a storage that is not there": (1, 10**9, 0, (10**9,), (1,)),
    "a tensor beyond its storage": (1, 1, 0, (10**9,), (1,)),
    "a place beyond its storage": (1, 1, 10**9, (1,), (1,)),
}
STORAGES |= {lie: view(*tensor) for lie, tensor in VIEWS.items()}


@pytest.mark.parametrize("attack", STORAGES)
def test_storages_that_pytorch_does_not_write_are_refused(attack):
    assert check_peak(attack, STORAGES[attack], lambda stream: load_tensors(stream.read()))


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
    for bomb, held in JSON_BOMBS.items():
        data = genuine["data"].decode().rstrip()[:-1] + f', "invented": {held}}}'
        yield bomb, zip_of({**genuine, "data": data}, zipfile.ZIP_DEFLATED)
    far = view(*VIEWS["no stride at all"])
    for member in ("policy.pth", "policy.optimizer.pth", "pytorch_variables.pth"):
        yield f"a lie in {member}", zip_of({**genuine, member: far})
    for wish, kwargs in NETWORKS.items():
        yield wish, zip_of(with_settings(genuine, policy_kwargs=kwargs))
    yield "many members", zip_of({**genuine, **{f"x{i}": b"" for i in range(30_000)}})
    inflated = zip_of({**genuine, "tensors.pth": bytes(400 * MB)}, zipfile.ZIP_DEFLATED)
    yield "a member that inflates", inflated
    size = (400 * MB).to_bytes(4, "little")
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


def look_into(stream):
    first_look(stream.read())


def test_memory_is_in_proportion_to_a_models_file(genuine, tmp_path):
    for attack, content in hostile_zips(genuine):
        path = tmp_path / "model.zip"
        path.write_bytes(content)
        assert check_peak(attack, content, partial(load_model, PPO)), attack
        check_peak(attack, content, look_into)
        check_peak(attack, content, lambda stream: inspect_model(path))  # noqa: B023


def test_a_hindsight_buffer_has_its_rows_in_the_file():
    """Its constructor makes a dictionary for each row that the file says it has."""
    env = BitFlippingEnv(n_bits=3, max_steps=3)
    settings = {"replay_buffer_class": HerReplayBuffer, "buffer_size": 50, "device": "cpu"}
    agent = DQN("MultiInputPolicy", env, **settings)
    buffer = io.BytesIO()
    agent.save_replay_buffer(buffer)
    rows = b"K2"  # of `buffer_size`
    where = buffer.getvalue().index(rows, buffer.getvalue().index(b"buffer_size"))
    more = buffer.getvalue()[:where] + b"J" + struct.pack("<i", 30 * 10**6)
    content = unframed(more + buffer.getvalue()[where + len(rows) :])
    told = check_peak("a buffer", content, lambda stream: load_replay_buffer(agent, stream))
    assert "wrong infos" in told


def unframed(pickled):
    """A pickle without the marks of how long its parts are."""
    start = pickled.index(b"\x95")
    assert pickled.count(b"\x95") == 1
    return pickled[:start] + pickled[start + 9 :]


def test_a_noise_is_not_copied_for_each_environment():
    """Its constructor copies the noise for one environment as often as there are environments."""
    fields = text("_base_noise") + noise(130_000) + text("_noises") + b"](" + b"h\x00" * 20_000
    vectorized = name(NOISE, "VectorizedActionNoise") + b")\x81}(" + fields + b"eub."
    content = START + noise(1) + b"\x940" + vectorized
    assert check_peak("a noise", content, lambda stream: read_pickle(stream.read())) == ""


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

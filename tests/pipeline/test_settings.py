"""Every text of settings that is read, and every mistake in one line: the table is settings.txt."""

import contextlib
import math
from pathlib import Path

import pytest
import stable_baselines3 as sb3
from hypothesis import given
from hypothesis import strategies as st

from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.settings.components import (
    build_algorithm_kwargs,
    build_value,
    callbacks,
    wrapper_factory,
)
from rl_yardstick.pipeline.settings.hyperparams import (
    check_algorithm_kwargs,
    read_hyperparams,
    split,
)
from rl_yardstick.pipeline.settings.values import (
    DottedName,
    algorithm_parameters,
    constructor_parameters,
    contains_name,
    parse_assignments,
    parse_literal,
    parse_schedule,
)
from rl_yardstick.pipeline.settings.yaml import parse_yaml

PARAMETERS = {
    "PPO": constructor_parameters(sb3.PPO),
    "DQN": constructor_parameters(sb3.DQN),
    "TD3": constructor_parameters(sb3.TD3),
    "TQC": algorithm_parameters(load_algorithm("tqc")),  # which does not say what schedules take
    "QLEARNING": constructor_parameters(load_algorithm("qlearning")),
}


def table():
    """Rows of section, text, mark and what is expected."""
    section = ""
    for line in Path(__file__).with_name("settings.txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("[") and " " not in line:
            section = line[1:-1]
        elif line and not line.startswith("#"):
            mark = "=>" if " => " in line else "!!"
            text, _, expected = line.partition(f" {mark} ")
            yield section, text.replace("\\n", "\n").replace("\\t", "\t"), mark, expected


def from_yaml(text):
    return parse_yaml(text, "yaml")


def read_argument(text):
    name, _, kwargs = text.partition(" ")
    read = check_algorithm_kwargs(from_yaml(kwargs), PARAMETERS[name], "arguments")
    return next(iter(read.values()))


def read_agent(text):
    kwargs = from_yaml(text)
    return build_algorithm_kwargs(sb3.PPO, kwargs and {"policy": "MlpPolicy", **kwargs}, "agent")


def in_file(text, folder):
    (folder / "ppo.yml").write_text(text, encoding="utf-8")
    return read_hyperparams("ppo", "A", folder / "ppo.yml")


READERS = {
    "yaml": from_yaml,
    "literal": lambda text: parse_literal(text, "literal"),
    "assignment": lambda text: next(iter(parse_assignments([text], "assignment").values())),
    "entry": lambda text: split(from_yaml(text), "entry"),
    "schedule": lambda text: parse_schedule(text, "schedule"),
    "arguments": read_argument,
    "wrapper": lambda text: wrapper_factory(from_yaml(text)),
    "callback": lambda text: callbacks(from_yaml(text)),
    "name": lambda text: build_value(DottedName(text), where="name"),
    "agent": read_agent,
}


@pytest.mark.parametrize(("section", "text", "mark", "expected"), [*table()])
def test_each_text_is_read_or_refused(section, text, mark, expected, tmp_path):
    def read():
        return in_file(text, tmp_path) if section == "file" else READERS[section](text)

    if mark == "=>":
        assert repr(read()) == expected
        return
    with pytest.raises(UserError) as caught:
        read()
    begins = {"file": f"{tmp_path / 'ppo.yml'}:", "wrapper": "env_wrapper"}.get(section, section)
    (line,) = str(caught.value).splitlines()
    assert line.startswith(begins)
    assert expected in line
    assert len(line) < 400


# --- files ---------------------------------------------------------------------------------------


def test_what_is_no_readable_file(tmp_path):
    (tmp_path / "large.yml").write_bytes(b"# " + b"x" * 600_000)
    for name, said in {
        "large.yml": r"large\.yml is larger than 262,144 bytes",
        "missing.yml": r"missing\.yml: cannot be read: No such file",
        "config.py": "Python files are not run",
    }.items():
        with pytest.raises(UserError, match=said):
            read_hyperparams("ppo", "A", tmp_path / name)


def test_what_is_shared_adds_up():
    lines = ["a0: &a0 [x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10)]
    with pytest.raises(UserError, match=r"^bomb:5:\d+: .*too large"):
        parse_yaml("\n".join(lines), "bomb")
    text = "A: &a {gamma: 0.5, n_envs: 2}\nB: &b {<<: *a, gamma: 0.6}\nC: {<<: *b}\n"
    read = parse_yaml(text, "file")
    assert read["B"] == read["C"] == {"gamma": 0.6, "n_envs": 2}


# --- literals and assignments --------------------------------------------------------------------


# --- entries and an agent's arguments ------------------------------------------------------------


def test_an_algorithms_own_defaults_pass():
    elsewhere = {"policy", "env", "seed", "device", "verbose", "tensorboard_log", "action_noise"}
    for algo in ALGORITHMS:
        parameters = constructor_parameters(load_algorithm(algo))
        defaults = {
            name: parameter.default
            for name, parameter in parameters.items()
            if name not in elsewhere and not name.startswith("_")
        }
        assert check_algorithm_kwargs(defaults, parameters, "here") == defaults, algo


# --- anything at all -----------------------------------------------------------------------------

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text()
)
LITERALS = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(st.text() | st.integers(), inner, max_size=4)
    ),
    max_leaves=15,
)
# What is close to being a literal finds more than plain noise does.
PIECES = [
    *"()[]{},:='\"1*.#\\\n\x00\ud800",
    *("dict", "-2", "1e-4", "**", "nn.Tanh", "__x", "lambda ", " for ", " in ", " if "),
    *("f'", "b''", "...", "not "),
]
FRAGMENTS = st.lists(st.sampled_from(PIECES), max_size=12).map("".join)
SCHEDULES = st.from_regex(r"(lin|exp|x)_[-0-9.e]{0,4}(_[-0-9.e]{0,4})?", fullmatch=True)


def read_or_refused(read, *args):
    """The value, or None if it is refused in one line that says where."""
    try:
        return read(*args)
    except UserError as error:
        (line,) = str(error).splitlines()
        assert line.startswith(("here", "hyperparameters"))
        assert len(line) < 400
        return None


@given(LITERALS)
def test_a_literal_is_read_back_from_its_repr(value):
    assert repr(parse_literal(repr(value))) == repr(value)


@given(st.text() | FRAGMENTS | SCHEDULES, st.binary())
def test_junk_is_read_or_refused_in_one_line(text, content):
    with contextlib.suppress(UserError):
        assert not contains_name(parse_assignments([f"key:{text}"]))
    read_or_refused(parse_literal, text, "here")
    for junk in (text, content):
        read_or_refused(parse_yaml, junk, "here")
    schedule = read_or_refused(parse_schedule, text, "here")
    if schedule is not None:
        assert math.isfinite(schedule.start)
        assert math.isfinite(schedule.end)

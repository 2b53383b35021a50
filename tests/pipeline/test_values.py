"""Literals and ``key:value`` lists are read without being run, and refused in one line."""

import contextlib
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import UserError, did_you_mean, one_line, unknown
from pipeline.settings.values import DottedName, contains_name, parse_assignments, parse_literal

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text()
)
KEYS = st.text() | st.integers()
LITERALS = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(KEYS, inner, max_size=4)
    ),
    max_leaves=15,
)
# What is close to being a literal finds more than plain noise does.
FRAGMENTS = st.lists(
    st.sampled_from(
        [
            *"()[]{},:='\"1*.#\\\n\x00\ud800",
            *("dict", "-2", "1e-4", "**", "nn.Tanh", "__x", "lambda ", " for ", " in ", " if "),
            *("f'", "b''", "...", "not "),
        ]
    ),
    max_size=12,
).map("".join)


@given(LITERALS)
def test_a_literal_is_read_back_from_its_repr(value: Any) -> None:
    assert parse_literal(repr(value)) == value


@given(LITERALS)
def test_types_survive_the_round_trip(value: Any) -> None:
    assert repr(parse_literal(repr(value))) == repr(value)


@given(st.text() | FRAGMENTS)
def test_junk_is_read_or_refused_in_one_line(text: str) -> None:
    try:
        parse_literal(text, "here")
    except UserError as error:
        message = str(error)
        assert message.startswith("here: ")
        assert len(message.splitlines()) == 1
        assert len(message) < 400


@given(st.lists(st.text() | FRAGMENTS.map("key:{}".format), max_size=3))
def test_junk_assignments_are_read_or_refused(assignments: list[str]) -> None:
    with contextlib.suppress(UserError):
        result = parse_assignments(assignments)
        assert len(result) == len(assignments)
        assert not contains_name(result)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-4", 1e-4),
        ("-1", -1),
        ("+1.5", 1.5),
        (" [64, 64] ", [64, 64]),
        ("(1, 'episode')", (1, "episode")),
        ("{'a': 1}", {"a": 1}),
        ("dict()", {}),
        ("dict(net_arch=dict(pi=[64], vf=[64]))", {"net_arch": {"pi": [64], "vf": [64]}}),
        ("dict(\n  a=1,\n  b=2)", {"a": 1, "b": 2}),
        ("list((1, 2))", [1, 2]),
        ("tuple([1, 2])", (1, 2)),
        ("nn.Tanh", DottedName("nn.Tanh")),
        (
            "dict(activation_fn=nn.Tanh, optimizer_class=RMSpropTFLike)",
            {
                "activation_fn": DottedName("nn.Tanh"),
                "optimizer_class": DottedName("RMSpropTFLike"),
            },
        ),
    ],
)
def test_what_hyperparameter_files_write(text: str, value: Any) -> None:
    assert parse_literal(text) == value
    assert type(parse_literal(text)) is type(value)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("dict(net_arch=[64", "column 15: invalid syntax ('[' was never closed)"),
        ("[1, 2 + 3]", "column 5: is not a literal"),
        ("['ä', f'{x}']", "column 7: is not a literal"),
        ("[1,\n open('x')]", "line 2, column 2: is not a literal"),
        ("{'a': 1, 'a': 2}", "column 15: key 'a' appears twice"),
        ("dict(a=1, a=2)", "key 'a' appears twice"),
        ("{(1, 2): 3}", "column 2: a key must be a text or a number"),
        ("dict(**{'a': 1})", "** is not read here"),
        ("{**{'a': 1}}", "** is not read here"),
        ("dict([('a', 1)])", "is not a literal"),
        ("list(5)", "list(...) needs a list or tuple"),
        ("-True", "a sign needs a number"),
        ("-'a'", "a sign needs a number"),
        ("b'bytes'", "is not a literal"),
        ("1j", "is not a literal"),
        ("{1, 2}", "is not a literal"),
        ("", "invalid syntax"),
        ("nn._Private", "column 1: _Private is private"),
        ("(" * 500, "column"),
        ("-" * 9_000 + "1", "cannot be read"),
        ("a" + ".a" * 4_900, "cannot be read"),
        ("1" * 20_000, "longer than 10000 characters"),
        ("9" * 6_000, "column 1"),
    ],
)
def test_what_is_refused_and_where(text: str, complaint: str) -> None:
    with pytest.raises(UserError) as caught:
        parse_literal(text, "ppo")
    assert str(caught.value).startswith("ppo: ")
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('touch {}')",
        "(lambda: open('{}', 'w'))()",
        "[open('{}', 'w')]",
        "[].__class__.__base__.__subclasses__()",
        "dict.__base__",
        "dict(a=dict.__base__)",
        "[x for x in [open('{}', 'w')]]",
        "dict(a=open('{}', 'w'))",
        "f\"{{open('{}', 'w')}}\"",
        "'a'.upper()",
        "(y := open('{}', 'w'))",
        "a[open('{}', 'w')]",
    ],
)
def test_nothing_is_ever_run(text: str, tmp_path: Any) -> None:
    target = tmp_path / "made"
    text = text.replace("{}", str(target))
    with pytest.raises(UserError):
        parse_literal(text)
    # As an argument it is a text like any other, refused where a mapping or number is wanted.
    assert parse_assignments([f"policy_kwargs:{text}"]) == {"policy_kwargs": text}
    assert not target.exists()


@pytest.mark.parametrize(
    ("assignment", "value"),
    [
        ("x:0.01", 0.01),
        ("x:1e-4", 1e-4),
        ("x:lin_1e-3", "lin_1e-3"),
        ("x:dict(net_arch=[64])", {"net_arch": [64]}),
        ("x:dict(act=nn.Tanh)", "dict(act=nn.Tanh)"),
        ("x:'text'", "text"),
        ('x:"text"', "text"),
        ("x:''", ""),
        ("x:map.txt", "map.txt"),
        ("x:MlpPolicy", "MlpPolicy"),
        ("x:C:\\maps\\a.txt", "C:\\maps\\a.txt"),
        ("x:/maps/a b.txt", "/maps/a b.txt"),
        ("x:False", False),
        ("x:false", False),
        ("x:no", False),
        ("x:None", None),
        ("x:null", None),
        ("x:1:30", "1:30"),
        ("x:2001-01-01", "2001-01-01"),
        ("x:[SFFF, FFFG]", ["SFFF", "FFFG"]),
        ("x:['SF', 'FG']", ["SF", "FG"]),
        ("x:{a: 1}", {"a": 1}),
        ("x:(1, 'episode')", (1, "episode")),
        ("x:dict(net_arch=[64", "dict(net_arch=[64"),
    ],
)
def test_values_on_the_command_line(assignment: str, value: Any) -> None:
    (read,) = parse_assignments([assignment]).values()
    assert read == value
    assert type(read) is type(value)


@pytest.mark.parametrize("assignment", ["gamma", "gamma=0.9", "gamma:", "gamma: ", ":0.9", "a-b:1"])
def test_an_assignment_of_another_form_is_refused(assignment: str) -> None:
    with pytest.raises(
        UserError, match=r"^-params: .* does not have the form key:value(: did you mean \S+\?)?$"
    ):
        parse_assignments(["size:8", assignment], "-params")


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("learning_rate=0.1 gamma:0.9", "learning_rate:0.1"),
        ("learning_rate 0.1", "learning_rate:0.1"),
        ("learning_rate = 0.1", "learning_rate:0.1"),
        ("learning_rate =0.1", "learning_rate:0.1"),
        ("learning_rate: 0.1 gamma:0.9", "learning_rate:0.1"),
        ("ent_coef=-1", "ent_coef:-1"),
        ("a=b=c", "a:b=c"),
        ("learning_rate gamma:0.9", ""),
        ("gamma", ""),
        ("a-b=1", ""),
    ],
)
def test_an_assignment_in_another_spelling_gets_ours(words: str, meant: str) -> None:
    with pytest.raises(UserError) as raised:
        parse_assignments(words.split())
    hint = str(raised.value).partition("key:value")[2]
    assert hint == (f": did you mean {meant}?" if meant else "")


def test_spaces_in_what_was_meant_are_quoted() -> None:
    with pytest.raises(
        UserError, match=r"did you mean 'policy_kwargs:dict\(net_arch=\[64, 64\]\)'"
    ):
        parse_assignments(["policy_kwargs=dict(net_arch=[64, 64])"])


def test_a_key_given_twice_is_refused() -> None:
    with pytest.raises(UserError, match=r"^'gamma' is given twice$"):
        parse_assignments(["gamma:0.9", "gamma:0.8"])


def test_an_infinite_literal_stays_infinite() -> None:
    assert parse_literal("-1e999") == -math.inf


def test_hints_name_the_nearest_else_a_short_list_else_nothing() -> None:
    assert did_you_mean("pppo", ["a2c", "ppo"]) == "did you mean 'ppo'?"
    assert did_you_mean("PPO", ["a2c", "ppo"]) == "did you mean 'ppo'?"
    assert did_you_mean("gamme", ["gamma", "gammb"], n=2) in {
        "did you mean 'gamma' or 'gammb'?",
        "did you mean 'gammb' or 'gamma'?",
    }
    assert did_you_mean("xyz", ["a2c", "ppo"]) == "known are a2c, ppo"
    assert did_you_mean("xyz", map(str, range(50))) == ""
    assert did_you_mean("xyz", []) == ""


def test_an_error_is_one_line() -> None:
    assert str(UserError("one\n  two")) == "one two"
    assert str(unknown("unknown agent", "ppoo", ["ppo"])) == (
        "unknown agent 'ppoo': did you mean 'ppo'?"
    )
    assert str(unknown("unknown agent", "x", [])) == "unknown agent 'x'"
    assert one_line(ValueError("one\n two")) == "one two"
    assert one_line(AssertionError()) == "AssertionError"

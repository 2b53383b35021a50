"""Logged pulls: reading, writing, and trying a policy on them by replay."""

import os
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

import envs  # noqa: F401
from envs.bandits import LoggedData, ReplayBandit, log_uniformly, read_log
from envs.known_models import time_limit, transition_model

LOG = Path(__file__).parent / "uniform_log.csv"


@pytest.fixture
def write(tmp_path: Path) -> Any:
    def written(text: str) -> Path:
        path = tmp_path / "log.csv"
        path.write_text(text, encoding="utf-8")
        return path

    return written


# --- reading --------------------------------------------------------------------------------------


def test_a_log_with_a_context_of_text() -> None:
    data = read_log(LOG)
    assert data.source == str(LOG)
    assert len(data) == 7
    assert data.context_names == ("segment",)
    assert data.categories == ("casual", "core")
    assert data.contexts[:, 0].tolist() == [1, 0, 0, 1, 0, 1, 0]
    assert data.arms.tolist() == [0, 1, 0, 1, 1, 0, 0]
    assert data.rewards.tolist() == [1, 0, 1, 1, 0, 0, 0.25]
    assert data.propensities is not None
    assert data.propensities.tolist() == [0.5] * 7
    assert data.n_arms == 2
    assert data.observation_space == spaces.Discrete(2)
    assert data.observations(spaces.Discrete(2)).tolist() == [1, 0, 0, 1, 0, 1, 0]


def test_columns_may_stand_in_any_order_and_propensities_be_missing(write: Any) -> None:
    data = read_log(write("reward,age,arm, income\n1.5,30,2,1e3\n\n-1,40.5,0,2000\n"))
    assert data.context_names == ("age", "income")
    assert data.contexts.tolist() == [[30, 1000], [40.5, 2000]]
    assert (data.arms.tolist(), data.rewards.tolist()) == ([2, 0], [1.5, -1])
    assert data.propensities is None
    assert data.categories is None
    box = data.observation_space
    assert isinstance(box, spaces.Box)
    assert (box.low.tolist(), box.high.tolist()) == ([30, 1000], [40.5, 2000])
    observations = data.observations(spaces.Box(-1, 1, (2,)))
    assert observations.dtype == np.float32
    assert observations.tolist() == [[30, 1000], [40.5, 2000]]


def test_a_file_that_a_spreadsheet_wrote(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes('\ufeffarm,reward,"who, where"\r\n0,1,"a, b"\r\n1,0,c\r\n'.encode())
    data = read_log(path)
    assert data.context_names == ("who, where",)
    assert data.categories == ("a, b", "c")


@pytest.mark.parametrize(
    ("values", "space"),
    [
        ("0 1 2 1", spaces.Discrete(3)),
        ("1 0 0 1", spaces.Discrete(2)),
        ("0 0 0 0", spaces.Discrete(1)),
        ("0 2 2 0", spaces.Box(0, 2, (1,))),
        ("1 2 3 1", spaces.Box(1, 3, (1,))),
        ("0 0.5 1 0", spaces.Box(0, 1, (1,))),
    ],
)
def test_when_one_column_of_numbers_is_discrete(
    write: Any, values: str, space: spaces.Space[Any]
) -> None:
    rows = "".join(f"{value},0,1\n" for value in values.split())
    assert read_log(write("segment,arm,reward\n" + rows)).observation_space == space


def test_a_log_without_context(write: Any) -> None:
    data = read_log(write("arm,reward\n1,1\n0,0\n"))
    assert data.contexts.shape == (2, 0)
    assert data.observation_space == spaces.Discrete(1)
    assert data.observations(spaces.Discrete(1)).tolist() == [0, 0]


def test_a_wider_space_than_the_logs_own_may_be_asked_for(write: Any) -> None:
    data = read_log(write("segment,arm,reward\n0,1,1\n2,0,0\n"))
    assert data.observations(spaces.Discrete(4)).tolist() == [0, 2]
    assert data.observations(spaces.Box(0, 9, (1,))).tolist() == [[0], [2]]


@pytest.mark.parametrize(
    ("columns", "space", "message"),
    [
        ("0 2", spaces.Discrete(2), "has the context segment, the agent observes one column of"),
        ("0 -1", spaces.Discrete(2), "one column of whole numbers from 0 to 1"),
        ("0 0.5", spaces.Discrete(2), "one column of whole numbers from 0 to 1"),
        ("a b", spaces.Discrete(3), "the context segment with 2 values of text, the agent"),
        ("a b", spaces.Box(0, 1, (1,)), "with 2 values of text, the agent observes Box"),
        ("0 1", spaces.Box(0, 1, (2,)), r"the agent observes Box\(0.0, 1.0, \(2,\), float32\)"),
        ("0 1", spaces.MultiBinary(1), r"the agent observes MultiBinary\(1\)"),
    ],
)
def test_contexts_that_an_agent_cannot_be_shown(
    write: Any, columns: str, space: spaces.Space[Any], message: str
) -> None:
    rows = "".join(f"{value},0,1\n" for value in columns.split())
    data = read_log(write("segment,arm,reward\n" + rows))
    with pytest.raises(ValueError, match=message) as refused:
        data.observations(space)
    assert str(refused.value).startswith(str(data.source))


def test_an_agent_with_contexts_on_a_log_with_none(write: Any) -> None:
    data = read_log(write("arm,reward\n1,1\n0,0\n"))
    for space in (spaces.Discrete(2), spaces.Box(0, 1, (1,))):
        with pytest.raises(ValueError, match="has no context, the agent observes"):
            data.observations(space)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no pulls: a header and a row for each are needed"),
        ("arm,reward\n", "holds no pulls: a header and a row for each are needed"),
        ("action,reward\n0,1\n", "has no column 'arm', only action, reward"),
        ("arm;reward\n0;1\n", "has no column 'arm', only arm;reward"),
        ("arm,click\n0,1\n", "has no column 'reward', only arm, click"),
        ("arm,reward,arm\n0,1,0\n", "has two columns 'arm'"),
        ("arm,reward\n0,1\n0\n", ", line 3 has 1 values, not 2"),
        ("arm,reward\n0,1\n\n0,1,2\n", ", line 4 has 3 values, not 2"),
        ("arm,reward\n0,1\n0,yes\n", ", line 3: reward is 'yes', it must be a finite number"),
        ("arm,reward\n0,\n", ", line 2: reward is '', it must be a finite number"),
        ("arm,reward\n0,nan\n", ", line 2: reward is 'nan', it must be a finite number"),
        ("arm,reward\n0,inf\n", ", line 2: reward is 'inf', it must be a finite number"),
        (
            "arm,reward\n0,1\n0.5,1\n",
            ", line 3: arm is '0.5', it must be a whole number from 0 to 9999",
        ),
        ("arm,reward\n-1,1\n", ", line 2: arm is '-1', it must be a whole number from 0"),
        ("arm,reward\n10000,1\n", ", line 2: arm is '10000', it must be a whole number"),
        ("arm,reward\nA,1\n", ", line 2: arm is 'A', it must be a whole number from 0"),
        (
            "arm,reward,propensity\n0,1,0.5\n0,1,0\n",
            ", line 3: propensity is '0', it must be a probability from 1e-09 to 1",
        ),
        ("arm,reward,propensity\n0,1,1.01\n", ", line 2: propensity is '1.01', it must be"),
        ("arm,reward,propensity\n0,1,-0.5\n", ", line 2: propensity is '-0.5', it must be"),
        (
            "arm,reward,x\n0,1,3\n0,1,core\n",
            ", line 3: x is 'core', it must be a finite number of no more than 1e15: text",
        ),
        ("arm,reward,x,y\n0,1,3,core\n", ", line 2: y is 'core', it must be a finite number"),
        ('arm,reward\n0,"1\n', "cannot read .*: unexpected end of data"),
    ],
)
def test_mistakes_in_a_log_are_named_with_their_line(write: Any, text: str, message: str) -> None:
    path = write(text)
    with pytest.raises(ValueError, match=message) as refused:
        read_log(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("column", "accepted", "refused"),
    [
        ("arm", ["0", "1", "9999", "1e3", "2.0"], ["-1", "-0.5", "10000", "9999.5", "nan", "inf"]),
        ("reward", ["0", "-1e15", "1e15", "5e-324"], ["nan", "inf", "-inf", "1.1e15", "-1e308"]),
        (
            "propensity",
            ["1e-9", "0.5", "0.9999999999999999", "1"],
            ["0", "9e-10", "1e-300", "-5e-324", "-1", "1.0000000000000002", "2", "nan", "inf"],
        ),
        ("age", ["0", "-1e15", "1e15"], ["nan", "inf", "-inf", "1.1e15"]),
    ],
)
def test_the_limits_of_each_column_from_both_sides(
    write: Any, column: str, accepted: list[str], refused: list[str]
) -> None:
    row = {"arm": "0", "reward": "1", "propensity": "0.5", "age": "30"}

    def log_with(value: str) -> Path:
        rows = [row.values(), {**row, column: value}.values()]
        return write("\n".join(",".join(cells) for cells in [row, *rows]))

    for value in accepted:
        data = read_log(log_with(value))
        read = {
            "arm": data.arms,
            "reward": data.rewards,
            "propensity": data.propensities,
            "age": data.contexts[:, 0],
        }
        found = read[column]
        assert found is not None
        assert found[1] == float(value)
    for value in refused:
        with pytest.raises(ValueError, match=f"line 3: {column} is '{value}', it must be"):
            read_log(log_with(value))


def test_one_pull_is_a_log(write: Any) -> None:
    data = read_log(write("arm,reward\n3,1\n"))
    assert (len(data), data.n_arms) == (1, 4)


@pytest.mark.parametrize(
    ("context", "n_contexts", "fits"),
    [("0", 3, True), ("2", 3, True), ("3", 3, False), ("-1", 3, False), ("0", 1, True)],
)
def test_the_first_and_the_last_context_that_an_agent_knows(
    write: Any, context: str, n_contexts: int, fits: bool
) -> None:
    data = read_log(write(f"segment,arm,reward\n0,0,1\n{context},0,1\n"))
    if fits:
        assert data.observations(spaces.Discrete(n_contexts)).tolist() == [0, int(context)]
    else:
        with pytest.raises(ValueError, match=f"whole numbers from 0 to {n_contexts - 1}"):
            data.observations(spaces.Discrete(n_contexts))


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cannot read .*missing\.csv: No such file or directory"):
        read_log(tmp_path / "missing.csv")
    (tmp_path / "binary.csv").write_bytes(b"arm,reward\n\xff\xfe,1\n")
    with pytest.raises(ValueError, match=r"cannot read .*binary\.csv: 'utf-8' codec can't decode"):
        read_log(tmp_path / "binary.csv")


def test_too_many_columns_are_refused_at_the_header(tmp_path: Path) -> None:
    path = tmp_path / "wide.csv"
    names = [f"x{i}" for i in range(5000)]
    path.write_text(",".join(["arm", "reward", *names]) + "\n" + "not a row\n", encoding="utf-8")
    with pytest.raises(ValueError, match="has 5,002 columns, more than 1,000"):
        read_log(path)


def test_what_is_no_regular_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    for path in (tmp_path / "pipe.csv", Path("/dev/zero"), tmp_path):
        with pytest.raises(ValueError, match="no regular file"):
            read_log(path)


FINITE = st.floats(-1e15, 1e15)


@given(rows=st.lists(st.tuples(FINITE, FINITE, st.integers(0, 9), FINITE), min_size=1))
def test_what_is_written_is_read_back_to_the_last_bit(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, float, int, float]]
) -> None:
    path = tmp_path_factory.mktemp("log") / "log.csv"
    lines = [",".join(map(repr, row)) for row in rows]
    path.write_text("x,y,arm,reward\n" + "\n".join(lines), encoding="utf-8")
    data = read_log(path)
    table = np.array(rows, dtype=np.float64)
    assert np.array_equal(data.contexts, table[:, :2])
    assert np.array_equal(data.arms, table[:, 2])
    assert np.array_equal(data.rewards, table[:, 3])


# --- writing --------------------------------------------------------------------------------------


def test_a_uniform_log_holds_what_the_environment_gave(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    log_uniformly(gym.make("SegmentBandit-v0", pulls=30), 100, seed=3, path=path)
    data = read_log(path)
    assert data.context_names == ("context",)
    assert data.observation_space == spaces.Discrete(2)
    assert data.propensities is not None
    assert set(data.propensities.tolist()) == {1 / 3}
    env = gym.make("SegmentBandit-v0", pulls=30)
    context, _ = env.reset(seed=3)
    for i, arm in enumerate(np.random.default_rng([3, 1]).integers(3, size=100).tolist()):
        assert (data.contexts[i, 0], data.arms[i]) == (context, arm)
        context, reward, _, truncated, _ = env.step(arm)
        assert data.rewards[i] == reward
        if truncated:
            context, _ = env.reset()


def test_a_uniform_log_of_vectors_and_of_nothing(tmp_path: Path) -> None:
    log_uniformly(gym.make("LinearBandit-v0"), 20, seed=0, path=tmp_path / "linear.csv")
    data = read_log(tmp_path / "linear.csv")
    assert data.context_names == tuple(f"feature_{i}" for i in range(5))
    first, _ = gym.make("LinearBandit-v0").reset(seed=0)
    space = gym.make("LinearBandit-v0").observation_space
    assert np.array_equal(data.observations(space)[0], first)
    log_uniformly(gym.make("BernoulliBandit-v0"), 20, seed=0, path=tmp_path / "coins.csv")
    assert read_log(tmp_path / "coins.csv").context_names == ()


# --- replay ---------------------------------------------------------------------------------------


def test_replay_by_hand() -> None:
    env = gym.make("ReplayBandit-v0", log=str(LOG))
    assert env.observation_space == spaces.Discrete(2)
    assert env.action_space == spaces.Discrete(2)
    assert time_limit(env) == 7
    assert transition_model(env) is None
    # Context after the step, reward, matched, matched pulls so far; the arm pulled is always 0.
    expected = [
        (0, 1.0, True, 1),
        (0, 0.0, False, 1),
        (1, 1.0, True, 2),
        (0, 0.0, False, 2),
        (1, 0.0, False, 2),
        (0, 0.0, True, 3),
        (0, 0.25, True, 4),
    ]
    for _ in range(2):
        assert env.reset(seed=0) == (1, {})
        for step, (context, reward, matched, matched_pulls) in enumerate(expected):
            assert env.step(0) == (
                context,
                reward,
                False,
                step == 6,
                {"matched": matched, "matched_pulls": matched_pulls, "feedback_due": True},
            )


def test_a_replay_of_vectors_shows_them_in_single_precision(write: Any) -> None:
    path = write("x,y,arm,reward,propensity\n0.1,1,0,1,0.5\n0.2,2,1,1,0.5\n")
    env = ReplayBandit(path)
    assert isinstance(env.observation_space, spaces.Box)
    first, _ = env.reset()
    second, *_ = env.step(0)
    assert np.array_equal(first, np.array([0.1, 1], np.float32))
    assert np.array_equal(second, np.array([0.2, 2], np.float32))
    assert env.observation_space.contains(first)
    assert env.observation_space.contains(second)


def test_the_end_of_the_log_cannot_be_passed() -> None:
    env = ReplayBandit(LOG)
    env.reset()
    for step in range(7):
        assert env.step(1)[3] == (step == 6)
    with pytest.raises(ValueError, match="has 7 rows: call reset after the last"):
        env.step(1)


def test_arms_that_were_never_pulled_are_known_from_the_propensities(write: Any) -> None:
    env = ReplayBandit(write("arm,reward,propensity\n0,1,0.2\n2,0,0.2\n"))
    assert env.action_space == spaces.Discrete(5)
    env = ReplayBandit(write("arm,reward,propensity\n0,1,0.33\n2,0,0.33\n"))
    assert env.action_space == spaces.Discrete(3)


def replay(env: gym.Env[Any, Any], policy: list[int]) -> tuple[float, int]:
    """The estimated mean reward of a policy, one arm for each context, and its matched pulls."""
    context, _ = env.reset(seed=0)
    total, truncated = 0.0, False
    while not truncated:
        context, reward, _, truncated, info = env.step(policy[context])
        total += float(reward)
    return total / info["matched_pulls"], info["matched_pulls"]


def test_replay_estimates_what_policies_are_worth(tmp_path: Path) -> None:
    n = 30_000
    log_uniformly(gym.make("SegmentBandit-v0", pulls=n), n, seed=0, path=tmp_path / "log.csv")
    env = gym.make("ReplayBandit-v0", log=str(tmp_path / "log.csv"))
    for policy, value in (([1, 0], 0.159), ([1, 1], 0.117), ([0, 0], 0.114), ([2, 2], 0.05)):
        estimate, matched = replay(env, policy)
        assert matched == pytest.approx(n / 3, abs=4 * np.sqrt(n * 2 / 9))
        assert estimate == pytest.approx(value, abs=4 * np.sqrt(value * (1 - value) / matched))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("arm,reward\n0,1\n", "has no column 'propensity': replay needs one, each value the"),
        (
            "arm,reward,propensity\n0,1,0.5\n1,0,0.5\n1,0,0.4\n",
            "did not choose among its 2 arms uniformly: the propensity of pull 3 is 0.4, not 0.5",
        ),
        (
            "arm,reward,propensity\n0,1,0.9\n1,0,0.1\n",
            "use inverse propensities instead: compare --logged .*log.csv --policy RUN",
        ),
        (
            "arm,reward,propensity\n0,1,0.5\n1,0,0.5\n2,0,0.5\n",
            "its 3 arms uniformly: the propensity of pull 1 is 0.5, not 0.3333",
        ),
        ("arm,reward,propensity\n0,1,1\n", "the propensity of pull 1 is 1, not 0.5"),
        ("arm,reward,propensity\n0,1,0.4\n1,1,0.4\n", "the propensity of pull 1 is 0.4, not 0.5"),
    ],
)
def test_logs_that_were_not_uniform_are_refused(write: Any, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        ReplayBandit(write(text))
    assert "\n" not in str(refused.value)


def test_replay_without_a_log_is_refused() -> None:
    with pytest.raises(ValueError, match="log must be the path to a CSV file of logged pulls"):
        gym.make("ReplayBandit-v0")


def test_data_made_by_hand_needs_no_file() -> None:
    data = LoggedData("made", (), np.empty((2, 0)), np.array([0, 3]), np.zeros(2), None)
    assert (data.n_arms, data.observation_space) == (4, spaces.Discrete(1))


@pytest.mark.parametrize(
    "row", ["1," * 2**20, "1" * 2**21, '"\n",' * 2**19], ids=["cells", "a cell", "lines"]
)
@pytest.mark.parametrize("header", ["", "arm,reward\n"])
def test_a_row_without_end_is_refused_before_it_is_read(tmp_path, header, row):
    path = tmp_path / "log.csv"
    path.write_text(header + row)
    with pytest.raises(ValueError, match=r"more than 1,048,576 characters|field larger") as refused:
        read_log(path)
    assert "\n" not in str(refused.value)


def test_a_log_is_read_in_pieces_without_a_seam(tmp_path, monkeypatch):
    lines = [f"{word},{i % 3},{i},0.5" for i, word in enumerate("zabzcabca")]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["word,arm,reward,propensity", *lines]))
    whole = read_log(path)
    monkeypatch.setattr("envs.bandits.logged.ROWS_AT_ONCE", 2)
    pieces = read_log(path)
    assert pieces.categories == whole.categories == ("a", "b", "c", "z")
    assert (
        pieces.contexts[:, 0].tolist()
        == whole.contexts[:, 0].tolist()
        == [3, 0, 1, 3, 2, 0, 1, 2, 0]
    )
    assert pieces.rewards.tolist() == list(range(9))


@pytest.mark.parametrize("first", ["1", "a"])
def test_text_and_numbers_in_different_pieces_do_not_mix(tmp_path, monkeypatch, first):
    monkeypatch.setattr("envs.bandits.logged.ROWS_AT_ONCE", 2)
    path = tmp_path / "log.csv"
    cells = [first, first, "a" if first == "1" else "1", "1"]
    path.write_text("word,arm,reward\n" + "".join(f"{cell},0,1\n" for cell in cells))
    with pytest.raises(ValueError, match="text can only be all of the context"):
        read_log(path)

"""Reading maps, refusing broken ones, and distances."""

from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import shortest_path

from envs.grid import GridMap, distances_to
from envs.mine_maze import MineMazeEnv
from envs.warehouse import WarehouseEnv

ROWS = ["..G", ".#.", "S.."]


def read(desc: Sequence[str] | str | Path) -> GridMap:
    return GridMap.read(desc, known="#.SG", passable=".S")


def test_a_map_is_read_from_rows() -> None:
    grid_map = read(ROWS)
    assert grid_map.rows == ("..G", ".#.", "S..")
    assert grid_map.codes == b"..G.#.S.."
    assert (grid_map.n_rows, grid_map.n_columns, grid_map.n_cells) == (3, 3, 9)
    assert grid_map.start == 6
    assert grid_map.distances.tolist() == [2, 1, 0, 3, -1, 1, 4, 3, 2]


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("end", ["", "\n", "\n\n"])
def test_a_map_is_read_from_a_file(tmp_path: Path, newline: str, end: str) -> None:
    path = tmp_path / "map.txt"
    path.write_bytes((newline.join(ROWS) + end.replace("\n", newline)).encode())
    assert read(path).rows == tuple(ROWS)
    assert read(str(path)).rows == tuple(ROWS)


def test_a_map_is_read_from_text() -> None:
    assert read("..G\n.#.\nS..\n").rows == tuple(ROWS)
    assert gym.make("envs:Warehouse-v0", desc="S.\n.G").observation_space.n == 4  # type: ignore[attr-defined]


def test_a_file_is_read_by_the_environments(tmp_path: Path) -> None:
    path = tmp_path / "map.txt"
    path.write_text("SG\n")
    for env in (WarehouseEnv(desc=str(path)), MineMazeEnv(desc=path)):
        assert env.desc.tolist() == [[b"S", b"G"]]


@pytest.mark.parametrize(
    ("desc", "message"),
    [
        ([], "the map is empty"),
        ([""], "the map is empty"),
        ("\n", "the map is empty"),
        (["S..", "..", "..G"], "row 2 has 2 cells and row 1 has 3: they differ from column 3 on"),
        (["S..", "....", "..G"], "row 2 has 4 cells and row 1 has 3: they differ from column 4 on"),
        (["...", "..G"], "the map has no start: mark it with the letter S"),
        (
            ["..S", "S.G"],
            "two starts, at row 1, column 3 and at row 2, column 1; there must be one",
        ),
        (["S..", "..."], "the map has no goal: mark it with the letter G"),
        (["S..", ".x.", "..G"], "unknown letter 'x' at row 2, column 2; known are # . S G"),
        (["S..", ". .", "..G"], "unknown letter ' ' at row 2, column 2"),
        (["S..", ".é.", "..G"], "unknown letter 'é' at row 2, column 2"),
        (
            ["S#.", "#..", "..G"],
            "the goal at row 3, column 3 cannot be reached from the start at row 1, column 1",
        ),
        ("missing.txt", "cannot read the map file missing.txt: No such file or directory"),
        (7, "desc must be a list of rows"),
        ([1, 2], "desc must be a list of rows"),
        (["S" + "." * 5000 + "G"] * 5000, "5000 rows of 5002 cells, more than 16,777,216 cells"),
    ],
)
def test_a_broken_map_is_refused(desc: Sequence[str], message: str) -> None:
    with pytest.raises(ValueError, match=message) as raised:
        WarehouseEnv(desc=desc)
    assert "\n" not in str(raised.value)


def test_a_broken_map_in_a_file_is_refused_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "map.txt"
    path.write_text("S.\n?G\n")
    with pytest.raises(ValueError, match=r"map\.txt: unknown letter '\?' at row 2, column 1"):
        WarehouseEnv(desc=path)
    path.write_bytes(b"S.\xff\xfe.G")
    with pytest.raises(ValueError, match=r"map\.txt: it is not a text file in UTF-8"):
        WarehouseEnv(desc=path)
    with pytest.raises(ValueError, match="is no regular file"):
        WarehouseEnv(desc=tmp_path)


def test_windows_marks_files_as_utf8_by_their_first_bytes(tmp_path: Path) -> None:
    path = tmp_path / "map.txt"
    path.write_bytes(b"\xef\xbb\xbfS.\r\n.G\r\n")
    rows = [WarehouseEnv(desc=desc).desc.tolist() for desc in (path, ["S.", ".G"])]
    assert rows[0] == rows[1]


def test_the_maze_names_its_own_letters() -> None:
    with pytest.raises(
        ValueError, match=r"unknown letter '#' at row 1, column 2; known are S \. M P"
    ):
        MineMazeEnv(desc=["S#G"])


def test_mines_block_the_way() -> None:
    with pytest.raises(ValueError, match="the goal at row 1, column 3 cannot be reached"):
        MineMazeEnv(desc=["SMG"])


def test_too_much_to_collect_is_refused() -> None:
    assert MineMazeEnv(desc=["S" + "P" * 18 + "G"]).dynamics.n_states == 20 * 2**18
    for n in (25, 100_000):
        message = f"the map has {n + 2} cells, {n} of them to collect: these make {n + 2} [*] 2[*]"
        with pytest.raises(ValueError, match=message):
            MineMazeEnv(desc=["S" + "P" * n + "G"])


def test_several_goals_are_allowed_and_the_nearest_counts() -> None:
    env = WarehouseEnv(desc=["G..S.G", "......"])
    assert env.shortest_path_length == 2


@given(
    st.integers(1, 7).flatmap(
        lambda width: st.lists(
            st.lists(st.booleans(), min_size=width, max_size=width), min_size=1, max_size=7
        )
    ),
    st.data(),
)
def test_distances_are_those_of_a_general_graph_search(
    rows: list[list[bool]], data: st.DataObject
) -> None:
    free = np.array(rows)
    cells = st.integers(0, free.size - 1)
    targets = data.draw(st.lists(cells, min_size=1, max_size=3, unique=True))
    row, column = np.divmod(np.arange(free.size), free.shape[1])
    apart = abs(row[:, None] - row) + abs(column[:, None] - column)
    usable = free.ravel().copy()
    usable[targets] = True
    edges = (apart == 1) & usable & usable[:, None]
    nearest = shortest_path(edges, unweighted=True, indices=targets).min(axis=0)
    expected = np.where(np.isfinite(nearest), nearest, -1)
    assert np.array_equal(distances_to(targets, free).ravel(), expected)


def test_a_map_without_end_is_not_read(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is no regular file"):
        WarehouseEnv(desc="/dev/zero")
    with (tmp_path / "large.txt").open("wb") as file:
        file.truncate(2**40)  # it takes no room on the disk
    with pytest.raises(ValueError, match="is larger than"):
        WarehouseEnv(desc=tmp_path / "large.txt")

"""Files that are only appended to: back to what they held, if they still begin with it."""

import pytest

from pipeline.errors import UserError
from pipeline.unfinished_runs import cut_back, log_positions

ROWS = b"r,l,t\n1.0,5,0.1\n2.0,6,0.2\n"


@pytest.fixture
def folders(tmp_path):
    run, log = tmp_path / "run", tmp_path / "log"
    run.mkdir()
    log.mkdir()
    (run / "0.monitor.csv").write_bytes(ROWS)
    (log / "events.out.tfevents.1").write_bytes(b"\x00events")
    return run, str(log)


def test_what_came_since_is_removed(folders):
    run, log = folders
    positions = log_positions(run, log)
    for path in (run / "0.monitor.csv", *(run.parent / "log").iterdir()):
        path.write_bytes(path.read_bytes() + b"more")
    (run / "1.monitor.csv").touch()
    cut_back(run, log, positions)
    assert [path.name for path in run.iterdir()] == ["0.monitor.csv"]
    assert log_positions(run, log) == positions
    assert (run / "0.monitor.csv").read_bytes() == ROWS


@pytest.mark.parametrize(
    "rows",
    [None, b"", ROWS[:-1], ROWS.replace(b"2.0", b"9.0"), ROWS.replace(b"r,l,t", b"t,l,r") + b"3.0"],
)
def test_what_was_changed_is_refused_and_left_alone(folders, rows):
    run, log = folders
    positions, path = log_positions(run, log), run / "0.monitor.csv"
    path.unlink()
    if rows is not None:
        path.write_bytes(rows)
    with pytest.raises(UserError, match=r"0\.monitor\.csv is not as the run left it"):
        cut_back(run, log, positions)
    assert (path.read_bytes() if path.exists() else None) == rows

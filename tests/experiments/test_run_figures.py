"""The files of a run's figures, where they have not the form that a run gives them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.run_figures import read_episodes, read_evaluations
from pipeline.digests import DamagedFileError
from pipeline.runs import Run


@pytest.mark.parametrize(
    "text",
    [
        "",
        "#{}",
        "#{}\n",
        "r,l,t\n1,2,3\n",
        "#{}\nr,l\n1,2\n",
        "#{}\nr,l,t\n1,2\n",
        "#{}\nr,l,t\nnan,2,3\n",
        "#{}\nr,l,t\n1,0,3\n",
        "#{}\nr,l,t\n1,two,3\n",
        "#{}\nr,l,t\n1e999,2,3\n",
        "#{}\nr,l,t\n1,2,3\n1,2\n",
        "#{}\nr,l,t\n1,2,\n",
        "#{}\nr,l,t\n1_0,2,3\n",
        "#{}\nr,l,t\nNA,2,3\n",
        '#{}\nr,l,t\n1,2,3\n"1,2,3\n',
        "#{}\n\0\0\xff\n",
    ],
)
def test_a_monitor_file_of_no_form(tmp_path, text):
    path = tmp_path / "0.monitor.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DamagedFileError, match=r"0\.monitor\.csv is damaged: ") as error:
        read_episodes(Run(tmp_path, "x"))
    assert "\n" not in str(error.value)


def test_a_monitor_file_without_episodes(tmp_path):
    (tmp_path / "0.monitor.csv").write_text('#{"t_start": 0}\nr,l,t\n')
    assert read_episodes(Run(tmp_path, "x")).returns.size == 0


@given(st.lists(st.floats(-1e300, 1e300), min_size=1, max_size=20))
def test_episodes_are_read_to_the_last_bit_whatever_stands_beside_them(tmp_path_factory, returns):
    path = tmp_path_factory.mktemp("run") / "0.monitor.csv"
    rows = [f'"left, or\nright",0.5,{value!r},3' for value in returns]
    path.write_text("\n".join(['#{"t_start": 0}', "way,t,r,l", *rows, ""]))
    episodes = read_episodes(Run(path.parent, "x"))
    assert episodes.returns.tolist() == returns
    assert episodes.steps.tolist() == [3 * n for n in range(1, len(returns) + 1)]
    assert set(episodes.seconds.tolist()) == {0.5}


@pytest.mark.parametrize(
    "arrays",
    [
        {"timesteps": [1]},
        {"timesteps": [1], "results": [1.0]},
        {"timesteps": [1, 2], "results": [[1.0]]},
        {"timesteps": [1], "results": [[np.nan]]},
        {"timesteps": [2, 1], "results": [[1.0], [1.0]]},
        {"timesteps": [-1], "results": [[1.0]]},
        {"timesteps": ["1"], "results": [[1.0]]},
    ],
)
def test_evaluations_of_no_form(tmp_path, arrays):
    run = Run(tmp_path, "x")
    np.savez(run.evaluations_path, **arrays)
    with pytest.raises(DamagedFileError, match=r"evaluations\.npz is damaged: "):
        read_evaluations(run)

"""``explain`` as a user types it: runs, zips, changes that are tried, files, refusals."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from rl_yardstick.pipeline.settings import read_entry
from rl_yardstick.report.documents import write_tables
from tests.pipeline.short_runs import CART, LAKE, trained


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lake")
    entry = read_entry("qlearning", LAKE)
    trained("qlearning", LAKE, {**entry, "n_timesteps": 3000}, folder=folder, save_freq=1000)
    return folder


@pytest.fixture
def run(type_command, logs, tmp_path):
    """A run of Q-learning that has not settled, with checkpoints."""
    shutil.copytree(logs, tmp_path / "logs")
    return "logs/qlearning/FrozenLake-v1_1"


def test_a_run_is_explained_in_twelve_lines_and_as_json(type_command, run):
    code, out, _ = type_command("explain", run, "--json", "why.json")
    data = json.loads(Path("why.json").read_text())
    assert code == 0
    assert len(out.splitlines()) <= 14  # which run, twelve lines, what to try
    assert f"gap {data['gap']:.4g}: it returns" in out
    assert sum(part["loss"] for part in data["parts"]) == pytest.approx(data["gap"])
    assert {"name", "loss", "visits", "action", "best", "updates"} <= data["states"][0].keys()
    zipped = type_command("explain", f"{run}/FrozenLake-v1.zip")[1]
    assert zipped.splitlines()[1:] == out.splitlines()[1:]


def test_a_change_is_tried_on_four_seeds_beside_the_run_as_it_is(type_command, run):
    words = ("--test", "n_timesteps:60000", "--test", "gamma:0.5", "--json", "why.json")
    code, out, _ = type_command("explain", run, *words, "-j", 1)
    tried = {
        one["change"]: one["returns"] for one in json.loads(Path("why.json").read_text())["tried"]
    }
    assert code == 0
    assert [*tried] == ["as shipped", "as it is", "n_timesteps:60000", "gamma:0.5"]
    assert {len(returns) for returns in tried.values()} == {4}
    assert "16 runs, 0 of them there already" in out
    assert "n_timesteps:60000 helps most" in out
    assert "16 runs, 16 of them there already" in type_command("explain", run, *words)[1]


def test_what_each_cell_costs_is_drawn_and_written_down(type_command, run, tmp_path):
    code = type_command("explain", run, "--map", "costs.png", "--json", "why.json")[0]
    data = json.loads(Path("why.json").read_text())
    assert code == 0
    assert sum(part["loss"] for part in data["parts"]) == pytest.approx(data["gap"])
    assert (tmp_path / "costs.png").read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_explained_is_refused_in_one_line(type_command, run):
    cart = trained("random", CART, n_timesteps=100)[0].path
    for words, line in (
        ([run, "--test", "gama:0.9"], "gama"),
        ([run, "--map", "costs.svg"], "--map writes a .png"),
        ([cart], "the model of CartPole-v1 is not known"),
    ):
        code, _, err = type_command("explain", *words)
        assert (code, err.count("\n")) == (2, 1)
        assert line in err


def test_of_a_study_the_median_run_of_a_pair_is_explained(type_command, report_study, tmp_path):
    folder = tmp_path / "moved"
    shutil.copytree(report_study.root, folder)
    write_tables(replace(report_study.analysis.results, root=folder))
    pair = ("--algo", "Q-learning & co", "--env", "FrozenLake-v1")
    code, out, _ = type_command("explain", folder, *pair, "--json", "why.json")
    table = report_study.analysis.results.summary
    rows = table[(table["agent"] == pair[1]) & (table["environment"] == pair[3])]
    assert code == 0
    assert str(folder) in out.splitlines()[0]
    assert json.loads(Path("why.json").read_text())["return"] == pytest.approx(rows["final"].min())
    code, _, err = type_command("explain", folder, *pair[:2])
    assert (code, err.count("\n")) == (2, 1)
    assert "choose one by --env: FrozenLake-v1, Warehouse-v0" in err

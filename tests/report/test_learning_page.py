"""The page that plays a training: what is in it, how large it may be, and how it is written."""

import base64
import gzip
import json
import re
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import carry_out, prepare
from report.page import learning
from report.page.frame import as_json
from report.page.learning import _layout_of, exactly, write_learning_page


@pytest.fixture
def watch(tmp_path):
    """Trains and writes the page; its data, its text and the training."""

    def done(env_id="Warehouse-v0", algo="qlearning", n_timesteps=200, settings=(), **fields):
        entry = {"n_timesteps": n_timesteps, **dict(settings)}
        common = {"seed": 1, "verbose": 0, "pictures": False, "log_folder": tmp_path / "logs"}
        path = tmp_path / "page.html"
        spec = TrainSpec(
            algo, env_id, split(entry), entry, **{**common, "watch_learning": path, **fields}
        )
        training = prepare(spec, Console(quiet=True), {}, "")
        carry_out(training)
        write_learning_page(spec, training.watch, path)
        text = path.read_text(encoding="utf-8")
        return data_in(text), text, training

    return done


def data_in(text):
    (packed,) = re.findall(r'<script type="text/plain" id="data">([^<]*)</script>', text)
    return json.loads(gzip.decompress(base64.b64decode(packed)))


def test_numbers_are_written_to_their_last_digit():
    values = np.array([0.1 + 0.2, 1e-300, -2.0, np.nan, np.inf, 123456789.123456789])
    assert json.loads(as_json({"values": values}, exactly)) == {
        "values": [0.30000000000000004, 1e-300, -2, None, "Infinity", 123456789.12345679]
    }


def test_the_data_are_what_was_recorded(watch):
    data, _, training = watch(settings={"env_kwargs": {"desc": ["S..", "#.G"]}})
    moves, changes = training.watch.moves.rows, training.watch.changes.rows
    assert data["kind"] == "steps"
    assert data["moves"]["td_error"] == moves["td_error"].tolist()
    assert data["moves"]["target"] == moves["target"].tolist()
    assert data["changes"]["after"] == changes["after"].tolist()
    assert data["tables"] == [{"name": "q_tables", "shape": [1, 6, 4], "fill": 0}]
    assert data["layout"]["rows"] == ["S..", "#.G"]
    assert data["layout"]["moves"] == [[-1, 0], [1, 0], [0, -1], [0, 1]]
    assert (data["n_states"], len(data["actions"]), data["is_cut"]) == (6, 4, False)


def test_the_map_is_that_of_the_training(watch):
    settings = {"env_kwargs": {"desc": ["S.G"]}, "train_env_kwargs": {"desc": ["G.S"]}}
    data, _, _ = watch(settings=settings)
    assert data["layout"]["rows"] == ["G.S"]


def test_where_observations_are_not_the_states_there_is_no_map():
    class Mirrored(gym.ObservationWrapper):
        def observation(self, obs):
            return 15 - obs

    env = gym.make("FrozenLake-v1")
    assert _layout_of(env, 16).rows[0] == "S..."
    assert _layout_of(Mirrored(env), 16) is None
    assert _layout_of(env, 17) is None


def test_without_a_map_states_are_numbers(watch):
    data, _, _ = watch("Taxi-v4", n_timesteps=50)
    assert (data["layout"], data["n_states"], data["is_drawn"]) == (None, 500, True)
    assert data["actions"][5] == "action 5"
    data, _, _ = watch("LinearBandit-v0", "linucb", n_timesteps=20)
    assert (data["n_states"], data["is_drawn"]) == (0, False)


def test_without_a_table_the_policy_in_every_state(watch):
    data, text, training = watch("FrozenLake-v1", "value_iteration", 128)
    assert (data["kind"], data["unit"], data["stride"]) == ("maps", "evaluation", 1)
    assert "from evaluation to evaluation" in text
    rows, moments = training.watch.moments.rows, data["moments"]
    assert moments["timesteps"] == rows["timesteps"].tolist()
    assert moments["timesteps"][0] == 0
    assert moments["actions"][-1] == rows["actions"][-1].tolist()
    assert moments["return"][-1] == rows["values"][-1][0]
    assert set(moments["loss"]) == {None}
    # Where an episode has ended nothing is done.
    reachable = training.watch.evaluator.model.reachable
    assert [value is not None for value in moments["values"][0]] == reachable.tolist()


def test_the_beginning_and_the_end_are_there_without_evaluations(watch):
    data, _, training = watch("FrozenLake-v1", "value_iteration", 64, eval_freq=-1)
    moments = data["moments"]
    assert moments["timesteps"] == [0, 64]
    assert moments["return"][-1] == training.watch.moments.rows["values"][-1][0] > 0.5


def test_of_a_network_the_page_says_which_updates_it_shows(watch, monkeypatch):
    settings = {"n_steps": 16, "batch_size": 16, "engine": "compiled"}
    data, text, training = watch("FrozenLake-v1", "ppo", 320, settings)
    assert "from update to update" in text
    assert "20 updates\n" in text.replace("</p>", "\n")
    assert data["moments"]["number"] == [*range(21)]
    path = training.spec.watch_learning
    # As large as the page is with every second one, and a letter less.
    monkeypatch.setattr(learning, "MOST_BYTES", len(text) - 1)
    write_learning_page(training.spec, training.watch, path)
    second = path.read_text(encoding="utf-8")
    assert "20 updates, one in 2 of which is shown" in second
    monkeypatch.setattr(learning, "MOST_BYTES", len(second.encode()) - 1)
    write_learning_page(training.spec, training.watch, path)
    text = path.read_text(encoding="utf-8")
    assert "20 updates, one in 4 of which is shown" in text
    assert data_in(text)["moments"]["number"] == [0, 4, 8, 12, 16, 20]
    assert data_in(text)["stride"] == 4


def test_a_page_is_no_larger_than_three_megabytes(watch, monkeypatch):
    _, text, training = watch("Taxi-v4", n_timesteps=2000)
    assert len(text) < learning.MOST_BYTES
    smaller = len(text) - 20_000
    monkeypatch.setattr(learning, "MOST_BYTES", smaller)
    path = training.spec.watch_learning
    write_learning_page(training.spec, training.watch, path)
    cut = data_in(path.read_text(encoding="utf-8"))
    assert path.stat().st_size <= smaller
    assert cut["is_cut"]
    asked = replace(training.spec, watch_episodes=3000)
    write_learning_page(asked, training.watch, path)
    said = r"a page has room for [\d,]+ steps, and ends before the first 3,000 episodes do"
    assert re.search(said, path.read_text(encoding="utf-8"))
    n_steps = len(cut["steps"]["timesteps"])
    assert 1 < n_steps < 2000
    assert len(cut["moves"]["step"]) == n_steps
    assert max(cut["changes"]["step"]) < n_steps


def test_the_fullest_page_is_no_larger_either(watch):
    """As much as is kept at most, and nothing of it like anything else."""
    _, _, training = watch("Taxi-v4", n_timesteps=20)
    recorder, rng = training.watch, np.random.default_rng(0)
    recorder.exact = None  # all that is kept is shown
    recorder.initial = {"q_tables": rng.normal(size=(1, 500, 6))}
    for rows, n in ((recorder.steps, 20_000), (recorder.moves, 20_000), (recorder.changes, 60_000)):
        more = np.zeros(n - len(rows), dtype=rows.rows.dtype)
        for name in more.dtype.names:
            whole = more.dtype[name] == np.int64
            more[name] = rng.integers(500, size=len(more)) if whole else rng.normal(size=len(more))
        more["timesteps" if n == 20_000 and rows is recorder.steps else "step"] = np.sort(
            rng.integers(20, 20_000, size=len(more))
        )
        rows.extend(more)
    more = recorder.changes.rows
    more["table"] = 0
    path = training.spec.watch_learning
    write_learning_page(training.spec, recorder, path)
    assert learning.MOST_BYTES / 2 < path.stat().st_size < 3_000_000


def test_a_page_is_replaced_whole(watch, small_disk):
    _, text, training = watch(n_timesteps=20)
    path = training.spec.watch_learning

    with small_disk(1000), pytest.raises(OSError, match="too large"):
        write_learning_page(training.spec, training.watch, path)
    assert path.read_text(encoding="utf-8") == text
    assert [other.name for other in path.parent.glob("*.tmp")] == []

"""``enjoy.py``: what it plays and refuses, and one picture that is drawn anew in its place."""

import io
import re
import shutil

import pytest
from PIL import Image
from rich.text import Text

from rl_yardstick.commands import enjoy
from rl_yardstick.commands.terminal import TextConsole
from rl_yardstick.pipeline.models import Wanted, find_model, load_agent
from rl_yardstick.report.films import FRAMES_PER_SECOND
from tests.pipeline.short_runs import LAKE, trained

PAIR = ["--algo", "random", "--env", LAKE]
PLAY = ["enjoy.py", *PAIR, "--no-render"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lake")
    run, _ = trained("random", folder=folder / "logs", n_timesteps=100, save_freq=40)
    shutil.copy(run.path / "rl_model_40_steps.zip", run.path / "best_model.zip")
    return folder


@pytest.fixture
def type_enjoy(typed, runs, tmp_path):
    """Type a command beside a run of a random agent on ice, with two checkpoints."""
    shutil.copytree(runs, tmp_path, dirs_exist_ok=True)
    return typed


def episodes(out):
    return [int(steps) for steps in re.findall(r"^episode \d+: return .*, (\d+) steps$", out, re.M)]


def test_so_many_steps_or_so_many_episodes_in_silence_if_asked(type_enjoy, tmp_path):
    lengths = episodes(type_enjoy.done(*PLAY))
    assert len(lengths) == 10
    assert episodes(type_enjoy.done(*PLAY, "-n", "500", "--n-episodes", "3")) == lengths[:3]
    assert sum(episodes(type_enjoy.done(*PLAY, "-n", "60"))) <= 60
    assert type_enjoy.done(*PLAY, "--verbose", "0") == ""
    words = ["--n-envs", "3", "--n-episodes", "8", "--reward-log", "returns"]
    out = type_enjoy.done("enjoy.py", *PAIR, *words)
    assert (len(episodes(out)), "(sampled, 8 episodes)" in out) == (8, True)
    assert len([*tmp_path.glob("returns/*.monitor.csv")]) == 3


RUN = f"logs/random/{LAKE}_1"
CHOICES = {
    "": f"{LAKE}.zip",
    "--load-last-checkpoint": "rl_model_80_steps.zip",
    "--load-checkpoint 40": "rl_model_40_steps.zip",
    "--load-best": "best_model.zip",
    RUN: f"{LAKE}.zip",
    f"{RUN}/rl_model_40_steps.zip": "rl_model_40_steps.zip",
}


@pytest.mark.parametrize("choice", CHOICES)
def test_the_chosen_model_is_played(type_enjoy, choice):
    pair = [] if choice.startswith("logs") else PAIR
    words = [*pair, *choice.split(), "--no-render", "--n-episodes", "3"]
    out = type_enjoy.done("enjoy.py", *words)
    assert len(episodes(out)) == 3
    assert out.splitlines()[0] == f"random on {LAKE}: {RUN}/{CHOICES[choice]}"
    assert re.search(r"^return [\d.]+ \(sampled, 3 episodes\)   length [\d.]+$", out, re.M)


def test_letters_and_films_of_each_step(typed, tmp_path):
    trained("random", "Warehouse-v0", n_timesteps=100)
    words = ["enjoy.py", "--algo", "random", "--env", "Warehouse-v0"]
    # The first frame and one for each of the five steps, ten rows of shelves each.
    assert typed.done(*words, "--render", "ansi", "-n", "5").count("#") > 6 * 30
    typed.done(*words, "--record", "film.gif", "-n", "7")
    # Equal frames in a row become one that is shown for longer.
    with Image.open(tmp_path / "film.gif") as picture:
        frames = [picture.seek(n) or picture.info["duration"] for n in range(picture.n_frames)]
    assert sum(frames) == 8 * 1000 // FRAMES_PER_SECOND


def test_a_run_is_played_where_its_map_is_not(typed):
    maze = {"env_kwargs": {"desc": ["S..", ".#.", "..G"]}}
    trained("random", "Warehouse-v0", maze, n_timesteps=9)
    words = ["--algo", "random", "--env", "Warehouse-v0", "--render", "ansi", "-n", "1"]
    assert " of 97 " in typed.done("enjoy.py", *words)


REPLACED = "\x1b[1A\x1b[2K"  # up a line, and it is empty


def test_pictures_replace_each_other_at_their_pace_with_figures_beside(tmp_path, monkeypatch):
    """An agent walks straight to the goal, on ice that is not slippery."""
    ice = {"env_kwargs": {"is_slippery": False}}
    trained("qlearning", LAKE, ice, folder=tmp_path, n_timesteps=3000)
    found = find_model(Wanted(algo="qlearning", env_id=LAKE, log_folder=tmp_path))
    pauses = []  # how long it would have waited between pictures
    monkeypatch.setattr(enjoy.time, "sleep", pauses.append)
    monkeypatch.setenv("TERM", "xterm")
    console = TextConsole(file=io.StringIO(), force_terminal=True, width=100, height=40)
    words = ["--render", "ansi", "--n-episodes", "2"]
    enjoy.play(console, found, enjoy.build_parser().parse_args(words))
    shown = console.file.getvalue()
    # Six steps to the goal: seven pictures an episode.
    assert pauses.count(0.25) == 14
    assert shown.count("step 0") == 2
    assert REPLACED in shown
    assert "episode 1: return 1.00, 6 steps" in shown
    # The last picture is the goal, with no step to come.
    assert "value" not in shown[shown.rindex("episode 2, step 6") :]
    # In the first, what the table holds stands beside the map.
    first = shown[: shown.index("step 1")]
    values = load_agent(found).policy.q_table[0]
    for number, name in zip(values, ("left", "down", "right", "up"), strict=True):
        assert name in first
        assert f"{number:.4g}" in first
    lines = Text.from_ansi(first).plain.splitlines()
    assert any("SFFF" in line and "left" in line for line in lines)

"""``enjoy.py``: what it plays and refuses, and one picture that is drawn anew in its place."""

import io
import re
import shlex
import shutil
import time
from collections import Counter
from types import SimpleNamespace

import pytest
from PIL import Image
from rich.text import Text

from rl_yardstick.commands import enjoy
from rl_yardstick.commands.enjoy import build_parser, play
from rl_yardstick.commands.terminal import TextConsole
from rl_yardstick.pipeline.models.choose import ModelRequest
from rl_yardstick.pipeline.models.load import load_to_play
from rl_yardstick.pipeline.playing import FRAMES_PER_SECOND
from tests.pipeline.short_runs import choose_model

LAKE = ["--algo", "random", "--env", "FrozenLake-v1"]
QUICK = ["train.py", "--seed", "0", "-n", "100", "--eval-freq", "-1", "--verbose", "1"]
PLAY = ["enjoy.py", *LAKE, "--no-render"]


@pytest.fixture(scope="module")
def trained(train_in, tmp_path_factory):
    words = ["-n", "100", "--eval-freq", "-1", "--save-freq", "40"]
    return train_in(tmp_path_factory.mktemp("lake"), *LAKE, *words)


@pytest.fixture
def lake(type_command, trained, tmp_path):
    """A run folder of a random agent on ice, with two checkpoints."""
    shutil.copytree(trained / "logs", tmp_path / "logs")
    return tmp_path / "logs" / "random" / "FrozenLake-v1_1"


def watch_line(out):
    (line,) = (line for line in out.splitlines() if line.startswith("watch"))
    return shlex.split(line)[2:]


def episodes(out):
    return [int(steps) for steps in re.findall(r"^episode \d+: return .*, (\d+) steps$", out, re.M)]


@pytest.mark.usefixtures("lake")
def test_so_many_steps_or_so_many_episodes_in_silence_if_asked(type_command):
    usual = type_command(*PLAY)
    lengths = episodes(usual[1])
    assert len(lengths) == 10
    assert len(episodes(type_command(*PLAY, "-n", "500")[1])) > 20
    both = episodes(type_command(*PLAY, "-n", "500", "--n-episodes", "3")[1])
    assert both == lengths[:3]
    assert sum(episodes(type_command(*PLAY, "-n", "60")[1])) <= 60
    assert type_command(*PLAY, "--verbose", "0") == (0, "", "")


@pytest.mark.usefixtures("lake")
def test_several_at_once_are_all_printed_and_logged(type_command, tmp_path):
    words = ["--n-envs", "3", "--n-episodes", "8", "--reward-log", "returns"]
    _, out, err = type_command("enjoy.py", *LAKE, *words)
    assert (err, len(episodes(out)), "(sampled, 8 episodes)" in out) == ("", 8, True)
    logs = [path.read_text() for path in (tmp_path / "returns").glob("*.monitor.csv")]
    assert len(logs) == 3
    logged = Counter(int(row.split(",")[1]) for log in logs for row in log.splitlines()[2:])
    # Some have ended one more meanwhile.
    assert Counter(episodes(out)) <= logged


RUN = "logs/random/FrozenLake-v1_1"


@pytest.mark.parametrize(
    ("choice", "n_steps"),
    [
        ([*LAKE, "--load-last-checkpoint"], 80),
        ([*LAKE, "--load-best"], 40),  # a checkpoint in its place
        ([f"{RUN}/rl_model_40_steps.zip"], 40),
    ],
)
def test_what_is_chosen_is_played_and_trained_further(type_command, lake, choice, n_steps):
    if "--load-best" in choice:
        shutil.copy(lake / "rl_model_40_steps.zip", lake / "best_model.zip")
    code, out, err = type_command("enjoy.py", *choice, "--no-render", "--n-episodes", "3")
    assert (code, err, len(episodes(out))) == (0, "", 3)
    assert re.search(r"^return [\d.]+ \(sampled, 3 episodes\)   length [\d.]+$", out, re.M)
    if choice[0] != "--algo":
        code, out, err = type_command(*QUICK, *LAKE, "-i", *choice)
        assert (code, err) == (0, "")
        assert f"trained  {n_steps + 100} steps" in out


CHECKPOINTS = "holds no rl_model_50_steps.zip: there are checkpoints after 40, 80 steps"
REFUSED = [
    ("--n-envs 2 --render ansi", "--render ansi shows one environment"),
    ("--vec-normalize x.pkl", "no such file of statistics: x.pkl"),
    ("--load-best", "holds no best_model.zip: its training may not have ended"),
    ("--load-checkpoint 50", CHECKPOINTS),
    ("truncated.zip", "no whole zip of an agent"),
]


def test_one_line_for_what_is_not_there_or_not_done(type_command, lake, tmp_path):
    (tmp_path / "truncated.zip").write_bytes((lake / "FrozenLake-v1.zip").read_bytes()[:-200])
    for words, complaint in REFUSED:
        code, _, err = type_command("enjoy.py", *LAKE, *words.split())
        assert (code, err.count("\n")) == (2, 1)
        assert complaint in err


# --- films ------------------------------------------------------------------------------------


def test_letters_and_films_of_each_step(type_command, tmp_path):
    house = ["--algo", "random", "--env", "Warehouse-v0"]
    assert type_command("train.py", *house, "-n", "100", "--eval-freq", "-1")[0] == 0
    code, out, _ = type_command("enjoy.py", *house, "--render", "ansi", "-n", "5")
    assert code == 0
    # The first frame and one for each of the five steps, ten rows of shelves each.
    assert out.count("#") > 6 * 30
    for film in ("film.gif", "film.mp4"):
        code, _, err = type_command("enjoy.py", *house, "--record", film, "-n", "7")
        assert (code, err) == (0, "")
    # Equal frames in a row become one that is shown for longer.
    with Image.open(tmp_path / "film.gif") as picture:
        frames = [picture.seek(n) or picture.info["duration"] for n in range(picture.n_frames)]
    assert sum(frames) == 8 * 1000 // FRAMES_PER_SECOND
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"


# --- from another place -------------------------------------------------------------------------

MAP = "S..\n.#.\n..G\n"
MAZE = ["--algo", "qlearning", "--env", "Warehouse-v0"]


def test_a_run_is_played_where_its_map_is_not(type_command, tmp_path, monkeypatch):
    """By the command that is printed after the training."""
    (tmp_path / "map.txt").write_text(MAP)
    text = "Warehouse-v0: {policy: QTablePolicy, n_timesteps: 9, env_kwargs: {desc: map.txt}}"
    (tmp_path / "own.yml").write_text(text)
    commands = []
    for given in (["--env-kwargs", "desc:map.txt"], ["--conf-file", "own.yml"]):
        code, out, err = type_command(*QUICK, *MAZE, *given, "-f", "my logs")
        assert (code, err) == (0, "")
        commands.append(watch_line(out))
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(tmp_path / "my logs", elsewhere / "my logs")
    (tmp_path / "map.txt").write_text("S.......G\n")
    monkeypatch.chdir(elsewhere)
    for number, command in enumerate(commands, start=1):
        words = [*command, "--exp-id", number, "--render", "ansi", "-n", "1"]
        code, out, err = type_command(*words)
        assert (code, err) == (0, "")
        assert "#" in out
        assert " of 97 " in out


# --- ``enjoy.py --render ansi`` on a terminal: one picture in its place, with figures beside it --

REPLACED = "\x1b[1A\x1b[2K"  # up a line, and it is empty


def test_pictures_replace_each_other_at_their_pace_with_figures_beside(
    train_in, tmp_path, monkeypatch
):
    """An agent walks straight to the goal, on ice that is not slippery."""
    ice = ["--algo", "qlearning", "--env", "FrozenLake-v1"]
    train_in(tmp_path, *ice, "-n", "3000", "--env-kwargs", "is_slippery:False")
    chosen = choose_model(ModelRequest(algo=ice[1], env_id=ice[3], log_folder=tmp_path / "logs"))
    pauses = []  # how long it would have waited between pictures
    clock = SimpleNamespace(sleep=pauses.append, monotonic=time.monotonic)
    monkeypatch.setattr(enjoy, "time", clock)
    monkeypatch.setenv("TERM", "xterm")
    console = TextConsole(file=io.StringIO(), force_terminal=True, width=100, height=40)
    words = ["--render", "ansi", "--n-episodes", "2", "--fps", "5"]
    play(console, chosen, build_parser().parse_args(words))
    shown = console.file.getvalue()
    # Six steps to the goal: seven pictures an episode.
    assert pauses == [0.2] * 14
    assert shown.count("step 0") == 2
    assert REPLACED in shown
    assert "episode 1: return 1.00, 6 steps" in shown
    # The last picture is the goal, with no step to come.
    assert "value" not in shown[shown.rindex("episode 2, step 6") :]
    # In the first, what the table holds stands beside the map.
    first = shown[: shown.index("step 1")]
    model = load_to_play("qlearning", chosen.file, None, "cpu", ())
    for number, name in zip(model.policy.q_table[0], ("left", "down", "right", "up"), strict=True):
        assert name in first
        assert f"{number:.4g}" in first
    lines = Text.from_ansi(first).plain.splitlines()
    assert any("SFFF" in line and "left" in line for line in lines)

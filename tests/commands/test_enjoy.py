"""``enjoy.py``: its flags, and one picture that is drawn anew in its place."""

import io
import re
import shlex
import shutil
import time
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

import train
from commands import enjoy
from commands.enjoy import LiveShow, build_parser, check_playing, figures_table, play
from commands.terminal import TextConsole
from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.errors import UserError
from pipeline.evaluation.policies import ActionFigures
from pipeline.models.choose import ModelRequest, choose_model
from pipeline.models.load import load_to_play
from pipeline.runs import Run

# --- flags of enjoy.py as users of rl_zoo3 know them, and commands that are printed to be typed----


LAKE = ["--algo", "random", "--env", "FrozenLake-v1"]
QUICK = ["train.py", "--seed", "0", "-n", "100", "--eval-freq", "-1", "--verbose", "1"]


def watch_line(out):
    (line,) = (line for line in out.splitlines() if line.startswith("watch"))
    return shlex.split(line)[2:]


@pytest.fixture
def lake(type_command):
    assert type_command(*QUICK, *LAKE)[0] == 0
    return ["enjoy.py", *LAKE, "--render", "none"]


def episodes(out):
    return [int(steps) for steps in re.findall(r"^episode \d+: return .*, (\d+) steps$", out, re.M)]


def test_so_many_steps_or_so_many_episodes(type_command, lake):
    lengths = episodes(type_command(*lake)[1])
    assert len(lengths) == 10
    assert len(episodes(type_command(*lake, "-n", "500")[1])) > 20
    both = episodes(type_command(*lake, "-n", "500", "--n-episodes", "3")[1])
    assert both == lengths[:3]
    assert sum(episodes(type_command(*lake, "-n", "60")[1])) <= 60


def test_several_at_once_are_all_printed_and_logged(type_command, lake, tmp_path):
    _, out, err = type_command(
        *lake[:-2], "--n-envs", "3", "--n-episodes", "8", "--reward-log", "returns"
    )
    assert err == ""
    assert len(episodes(out)) == 8
    assert "over 8 episodes" in out
    logs = list((tmp_path / "returns").glob("*.monitor.csv"))
    assert len(logs) == 3
    logged = Counter(
        int(row.split(",")[1]) for path in logs for row in path.read_text().splitlines()[2:]
    )
    # Some have ended one more meanwhile.
    assert Counter(episodes(out)) <= logged


def test_nothing_is_said_with_verbose_0(type_command, lake):
    assert type_command(*lake, "--verbose", "0") == (0, "", "")


@pytest.mark.parametrize(
    ("flags", "answer"),
    [
        (["-P"], "-P: there is no bar; each episode is printed as it ends"),
        (["--n-envs", "0"], "--n-envs: must be a whole number of at least 1, not '0'"),
        (["--n-envs", "2", "--render", "ansi"], "--render ansi shows one environment"),
        (["--n-envs", "2", "--record", "film.gif"], "--record shows one environment"),
        (["--exp-id", "-1"], "holds no FrozenLake-v1.zip"),
        (["--vec-normalize", "x.pkl"], "no such file of statistics: x.pkl"),
    ],
)
def test_one_line_for_what_is_not_done(type_command, lake, flags, answer):
    code, out, err = type_command(*lake[:-2], *flags)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert answer in err


def test_flags_that_ask_for_what_is_always_done(type_command, lake):
    assert type_command(*lake, "--custom-objects", "--deterministic") == type_command(*lake)


def test_a_checkpoint_that_is_not_there(type_command):
    type_command(*QUICK, *LAKE, "--save-freq", "40")
    code, _, err = type_command("enjoy.py", *LAKE, "--no-render", "--load-checkpoint", "50")
    assert code == 2
    assert "holds no rl_model_50_steps.zip: there are checkpoints after 40, 80 steps" in err


@pytest.mark.parametrize("path", ["", "FrozenLake-v1", "FrozenLake-v1.zip", "rl_model_40_steps"])
def test_paths_of_all_kinds(type_command, tmp_path, path):
    type_command(*QUICK, *LAKE, "--save-freq", "40")
    path = f"logs/random/FrozenLake-v1_1/{path}"
    code, out, err = type_command("enjoy.py", path, "--no-render")
    assert (code, err, len(episodes(out))) == (0, "", 10)
    code, out, err = type_command(*QUICK, *LAKE, "-i", path)
    assert (code, err) == (0, "")
    assert f"trained  {140 if '40' in path else 200} steps" in out


# --- from another place --------------------------------------------------------------------------

MAP = "S..\n.#.\n..G\n"
MAZE = ["--algo", "qlearning", "--env", "Warehouse-v0"]


def of_a_file(folder):
    """The map in an entry of a file of hyperparameters."""
    text = "Warehouse-v0: {policy: QTablePolicy, n_timesteps: 9, env_kwargs: {desc: map.txt}}"
    (folder / "own.yml").write_text(text)
    return ["--conf-file", "own.yml"]


@pytest.mark.parametrize("given", [lambda folder: ["--env-kwargs", "desc:map.txt"], of_a_file])
def test_a_run_is_played_where_its_map_is_not(type_command, tmp_path, monkeypatch, given):
    (tmp_path / "map.txt").write_text(MAP)
    code, out, err = type_command(*QUICK, *MAZE, *given(tmp_path))
    assert (code, err) == (0, "")
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(tmp_path / "logs", elsewhere / "logs")
    (tmp_path / "map.txt").write_text("S.......G\n")
    monkeypatch.chdir(elsewhere)
    code, out, err = type_command(*watch_line(out), "--render", "ansi", "-n", "1")
    assert (code, err) == (0, "")
    assert re.search(r"#", out)
    assert "optimum 97.00" in out


def test_the_arguments_of_now_win_over_those_of_evaluation(type_command):
    type_command(*QUICK, *MAZE, "--eval-env-kwargs", "max_episode_steps:20")
    words = ["enjoy.py", *MAZE, "--no-render", "--n-episodes", "1", "--stochastic"]
    assert max(episodes(type_command(*words)[1])) <= 20
    words += ["--env-kwargs", "max_episode_steps:3"]
    assert episodes(type_command(*words)[1]) == [3]


@pytest.mark.parametrize("env_id", ["envs:FrozenLake-v1", "FrozenLake-v1"])
def test_the_printed_command_plays_this_very_run(type_command, env_id):
    words = [*QUICK, "--algo", "random", "--env", env_id, "-f", "my logs"]
    _, out, _ = type_command(*words)
    assert type_command(*watch_line(out), "--no-render")[0] == 0
    assert watch_line(out)[-2:] == ["-f", "my logs"]


@pytest.mark.parametrize(
    ("env_id", "folder"),
    [("envs:Warehouse-v0", "Warehouse-v0_1"), ("ALE/Pong-v5", "ALE-Pong-v5_1")],
)
def test_an_id_names_the_same_folder_everywhere(tmp_path, monkeypatch, env_id, folder):
    assert Run.claim(tmp_path, "random", env_id).path.name == folder
    if env_id.startswith("envs"):
        environment = EnvironmentSpec(env_id, env_id, {"n_timesteps": 9})
        study = StudySpec("s", "S", (AgentSpec("random", "random"),), (environment,), n_seeds=1)
        (planned,) = plan(study, tmp_path)
        assert planned.path.name == folder
        planned.path.mkdir(parents=True)
        assert Run.find(tmp_path / "runs", "random", env_id).path == planned.path


def test_a_study_remembers_maps_by_their_contents(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.txt").write_text(MAP)
    environment = EnvironmentSpec("Small", "Warehouse-v0", {"env_kwargs": {"desc": "map.txt"}})
    study = StudySpec("s", "S", (AgentSpec("qlearning", "qlearning"),), (environment,), n_seeds=1)
    (planned,) = plan(study, tmp_path)
    assert planned.spec.as_data()["hyperparams"]["env_kwargs"]["desc"] == MAP.split()


def test_normalised_returns_need_statistics(type_command, lake):
    code, _, err = type_command(*lake, "--norm-reward")
    assert (code, err.count("\n")) == (2, 1)
    assert "--norm-reward: no statistics of VecNormalize belong to this model" in err


# --- ``enjoy.py --render ansi`` on a terminal: one picture in its place, with figures beside it----


REPLACED = "\x1b[1A\x1b[2K"  # up a line, and it is empty


@pytest.fixture
def on_ice(monkeypatch, tmp_path):
    """Trains an agent for so many steps on ice that is not slippery."""

    def trained(n_steps):
        monkeypatch.chdir(tmp_path)
        words = ["--algo", "qlearning", "--env", "FrozenLake-v1", "-n", str(n_steps)]
        words += ["--env-kwargs", "is_slippery:False", "--seed", "0", "--verbose", "0"]
        monkeypatch.setattr("sys.argv", ["train.py", *words])
        assert train.main() == 0
        return choose_model(ModelRequest(algo="qlearning", env_id="FrozenLake-v1"))

    return trained


@pytest.fixture
def walker(on_ice):
    """An agent that walks straight to the goal."""
    return on_ice(3000)


@pytest.fixture
def pauses(monkeypatch):
    """How long it would have waited between pictures."""
    waited = []
    clock = SimpleNamespace(sleep=waited.append, monotonic=time.monotonic)
    monkeypatch.setattr(enjoy, "time", clock)
    return waited


def letters(*words):
    return build_parser().parse_args(["--render", "ansi", *map(str, words)])


def played(chosen, *words, width=100):
    console = TextConsole(file=io.StringIO(), force_terminal=True, width=width, height=40)
    play(console, chosen, letters(*words))
    return console.file.getvalue()


def test_pictures_replace_each_other_at_their_pace(walker, pauses, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    shown = played(walker, "--n-episodes", 2, "--fps", 5)
    # Six steps to the goal: seven pictures an episode.
    assert pauses == [0.2] * 14
    assert shown.count("step 0") == 2
    assert shown.count(REPLACED) > 0
    assert "episode 1: return 1.00, 6 steps" in shown
    assert "return 1.00 ± 0.00 over 2 episodes" in without_style(shown)
    # The last picture is the goal, with no step to come.
    last = shown.rindex("episode 2, step 6")
    assert "value" not in shown[last:]


def test_what_the_table_holds_stands_beside_the_map(walker, pauses, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    shown = played(walker, "--n-episodes", 1)
    first = shown[: shown.index("step 1")]
    for name in ("left", "down", "right", "up"):
        assert name in first
    model = load_to_play("qlearning", walker.file, None, "cpu", ())
    for number in model.policy.q_table[0]:
        assert f"{number:.4g}" in first
    assert any("SFFF" in line and "left" in line for line in without_style(first).splitlines())
    # Where there is no room beside the map, they stand below it.
    narrow = without_style(played(walker, "--n-episodes", 1, width=30))
    assert any(line.strip() == "SFFF" for line in narrow.splitlines())


def without_style(text):
    from rich.text import Text

    return Text.from_ansi(text).plain


def test_elsewhere_pictures_stand_one_below_the_other(walker, pauses):
    console = TextConsole(file=io.StringIO())
    play(console, walker, letters("--n-episodes", 1))
    shown = console.file.getvalue()
    assert without_style(shown).count("SFFF") == 7
    assert pauses == []
    assert REPLACED not in shown
    assert "value" not in shown


def test_a_playing_that_is_broken_off_shows_where_it_was(walker, pauses, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    assert "episode 1, step 3" in played(walker, "-n", 3)


def test_bars_lie_between_the_lowest_and_the_highest():
    table = figures_table(ActionFigures("value", np.array([-1.0, 0.0, 3.0])), 2, ("a", "b"))
    console = TextConsole(file=io.StringIO(), width=60)
    console.print(table)
    rows = [line.split() for line in console.file.getvalue().splitlines()]
    assert rows[1:] == [["a", "-1"], ["b", "0", "###"], [">", "2", "3", "#" * 12]]


def rows_of(table, width=60):
    console = TextConsole(file=io.StringIO(), width=width)
    console.print(table)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize(("n_shown", "n_rows"), [(20, 20), (5, 5), (0, 1), (-3, 1)])
def test_of_many_actions_the_chosen_one_is_among_those_there_is_room_for(n_shown, n_rows):
    figures = ActionFigures("value", np.arange(100.0))
    rows = rows_of(figures_table(figures, 99, (), n_shown))
    assert len(rows) == 1 + n_rows
    assert rows[-1].split() == [">", "99", "99", "#" * 12]
    rows = rows_of(figures_table(figures, 0, (), n_shown))
    assert len(rows) == 1 + n_rows
    assert rows[1].split() == [">", "0", "0"]


@pytest.mark.parametrize("numbers", [[np.nan, 1.0], [np.inf, 0.0], [0.0, 0.0]])
def test_without_a_range_there_are_no_bars(numbers):
    rows = rows_of(figures_table(ActionFigures("value", np.array(numbers)), 0, ()))
    assert "#" not in "".join(rows)
    assert rows[0].split() == ["action", "value"]


def test_bars_give_way_where_it_is_narrow_and_nothing_moves_sideways():
    figures = ActionFigures("probability", np.array([1e-5, 1.0]))
    one, other = (
        rows_of(figures_table(figures, chosen, ("left", "right"), width=width), width)
        for chosen, width in ((0, 26), (1, 26))
    )
    assert {len(row) for row in (*one, *other)} == {26}
    assert one[2].split() == ["right", "1", "#" * 5]
    assert rows_of(figures_table(figures, 1, (), width=10), 30)[2].split() == [">", "1", "1"]


def test_what_an_environment_draws_moves_no_cursor(pauses, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    console = TextConsole(file=io.StringIO(), force_terminal=True, width=60)
    frames = [["\x1b[2J\x1b]0;taken\x07[red]S\x1b[31mR\x1b[0m"]]
    taker = SimpleNamespace(take=lambda done: frames.pop() if frames else [])
    agent = SimpleNamespace(policy=None, action_space=None)
    show = LiveShow(console, agent, taker, 4)
    with show.shown():
        show.before_step(np.array([0]), np.array([0]))
    shown = console.file.getvalue()
    assert "\x1b[2J" not in shown
    assert "\x1b]0" not in shown
    assert "[red]S" in shown


def test_a_pace_is_for_letters_alone():
    for words in (["--fps", "3"], ["--fps", "3", "--render", "none"]):
        with pytest.raises(UserError, match="--fps is the pace of --render ansi: give that too"):
            check_playing(build_parser().parse_args(words))
    args = build_parser().parse_args(["--fps", "3", "--render", "ansi"])
    check_playing(args)
    for wrong in ("0", "61", "x"):
        with pytest.raises(SystemExit):
            build_parser().parse_args(["--fps", wrong])


@pytest.fixture
def wall(on_ice):
    """An agent that has learnt nothing, and walks against the wall until the time limit."""
    return on_ice(1)


def test_what_repeats_itself_is_shown_for_a_while(wall, pauses, monkeypatch):
    """The start, one step against the wall, and 20 that look like it, of 100; then it is told."""
    console = TextConsole(file=io.StringIO())
    play(console, wall, letters("--n-episodes", 2))
    shown = without_style(console.file.getvalue())
    assert shown.count("SFFF") == 2 * 22
    assert shown.count("... 79 steps left out, which repeat pictures from above") == 2
    assert shown.count("return 0.00, 100 steps") == 2
    monkeypatch.setenv("TERM", "xterm")
    shown = without_style(played(wall, "--n-episodes", 2))
    assert shown.count("step 22: it repeats itself, and is not shown any more") == 2
    assert shown.count("return 0.00, 100 steps") == 2
    assert len(pauses) == 2 * 23  # the last one after the end

"""Flags of enjoy.py as users of rl_zoo3 know them, and commands that are printed to be typed."""

import re
import shlex
import shutil
from collections import Counter

import pytest

from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.runs import Run

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

"""train.py and enjoy.py as a user types them."""

import importlib.util
import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml

import train
from commands import compare
from commands.compare import study_spec
from commands.train import build_parser, train_spec
from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.environments import training_kwargs
from pipeline.errors import UserError
from pipeline.playing import FRAMES_PER_SECOND, check_film_path, write_film
from pipeline.settings import hyperparams

ROOT = Path(train.__file__).parent
QUICK = ["--algo", "qlearning", "--env", "FrozenLake-v1", "--seed", "0", "-n", "500"]


def contents(folder):
    return sorted(path.name for path in folder.rglob("*"))


@pytest.mark.usefixtures("pictures")
def test_a_run_folder_is_whole(type_command, tmp_path):
    code, out, err = type_command("train.py", *QUICK, "--save-freq", "200")
    assert (code, err) == (0, "")
    run = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    assert contents(run) == sorted(
        [
            "0.monitor.csv",
            "FrozenLake-v1",
            "FrozenLake-v1.zip",
            "args.yml",
            "best_model.zip",
            "command.txt",
            "config.yml",
            "evaluations.npz",
            "learning_curve.png",
            "rl_model_200_steps.zip",
            "rl_model_400_steps.zip",
            "run.json",
            "value_map.png",
            "value_maps.npz",
        ]
    )
    info = json.loads((run / "run.json").read_text())
    assert info["state"] == "finished"
    assert info["n_timesteps"] == 500
    assert info["final"]["exact"]
    assert info["final"]["optimum"] == pytest.approx(0.7442, abs=1e-4)
    assert info["engine"] == "compiled"
    assert f"return {info['final']['mean_return']:.2f} (exact)" in out
    assert "logs/qlearning/FrozenLake-v1_1" in out
    config = yaml.safe_load((run / "FrozenLake-v1" / "config.yml").read_text())
    assert config["n_timesteps"] == 500
    assert "--seed 0" in (run / "FrozenLake-v1" / "command.txt").read_text()
    with np.load(run / "evaluations.npz") as evaluations:
        assert evaluations["results"].shape == (20, 2)
        assert evaluations["timesteps"][-1] == 500


def test_sampled_evaluation_where_the_model_is_not_known(type_command, tmp_path):
    words = ["--algo", "angle", "--env", "CartPole-v1", "-n", "1000", "--seed", "0"]
    code, out, _ = type_command("train.py", *words)
    assert code == 0
    assert "over 25 episodes" in out
    run = tmp_path / "logs" / "angle" / "CartPole-v1_1"
    final = json.loads((run / "run.json").read_text())["final"]
    assert (final["exact"], final["n_episodes"]) == (False, 25)
    n_evaluations, n_episodes = np.load(run / "evaluations.npz")["results"].shape
    # Twenty moments, of which those are left out that there are no steps for.
    assert (n_evaluations, n_episodes) == (3, 5)


def test_the_same_seed_gives_the_same_run(type_command, tmp_path):
    for _ in range(2):
        assert type_command("train.py", *QUICK)[0] == 0
    runs = [tmp_path / "logs" / "qlearning" / f"FrozenLake-v1_{n}" for n in (1, 2)]
    rows = [(run / "0.monitor.csv").read_text().splitlines()[2:] for run in runs]
    without_time = [[row.rsplit(",", 1)[0] for row in table] for table in rows]
    assert without_time[0] == without_time[1]
    data = [zipfile.ZipFile(run / "FrozenLake-v1.zip").read("policy.pth") for run in runs]
    assert data[0] == data[1]


def test_playing_the_newest_the_best_and_a_path(type_command, tmp_path):
    type_command("train.py", *QUICK, "--save-freq", "200")
    run = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    choices = [
        ["--algo", "qlearning", "--env", "FrozenLake-v1"],
        ["--algo", "qlearning", "--env", "FrozenLake-v1", "--load-best"],
        ["--algo", "qlearning", "--env", "FrozenLake-v1", "--load-checkpoint", "200"],
        ["--algo", "qlearning", "--env", "FrozenLake-v1", "--load-last-checkpoint"],
        [run / "rl_model_400_steps.zip"],
    ]
    for choice in choices:
        code, out, err = type_command("enjoy.py", *choice, "--render", "none", "--n-episodes", "3")
        assert (code, err) == (0, "")
        assert re.search(r"return \d\.\d\d ± \d\.\d\d over 3 episodes", out)
    assert out.count("episode ") == 3


def test_watching_in_the_terminal_shows_the_last_frame(type_command):
    type_command("train.py", "--algo", "random", "--env", "Warehouse-v0", "-n", "300")
    code, out, _ = type_command(
        "enjoy.py", "--algo", "random", "--env", "Warehouse-v0", "--render", "ansi", "-n", "5"
    )
    assert code == 0
    # The first frame and one for each of the five steps, ten rows of shelves each.
    assert out.count("#") > 6 * 30


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_filming(type_command, tmp_path, suffix):
    from PIL import Image

    type_command("train.py", "--algo", "random", "--env", "Warehouse-v0", "-n", "300")
    code, _, err = type_command(
        *("enjoy.py", "--algo", "random", "--env", "Warehouse-v0"),
        *("--record", f"film.{suffix}", "-n", "7"),
    )
    assert (code, err) == (0, "")
    film = tmp_path / f"film.{suffix}"
    if suffix == "gif":
        # Equal frames in a row become one that is shown for longer.
        with Image.open(film) as picture:
            durations = []
            for frame in range(picture.n_frames):
                picture.seek(frame)
                durations.append(picture.info["duration"])
        assert sum(durations) == 8 * 1000 // FRAMES_PER_SECOND
    else:
        assert film.read_bytes()[4:8] == b"ftyp"


def test_where_no_film_can_be_written_nothing_is_played(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda *_: False)  # as on a read-only disk, also for root
    with pytest.raises(UserError, match="--record: nothing can be written in "):
        check_film_path(tmp_path / "film.gif")


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_a_film_that_finds_the_disk_full_leaves_the_one_before_it(tmp_path, small_disk, suffix):
    film = tmp_path / f"film.{suffix}"
    film.write_bytes(b"an earlier one")
    with small_disk(20), pytest.raises(OSError, match=r"too large|no whole film"):
        write_film(film, [np.zeros((8, 8, 3), np.uint8)])
    assert [path.name for path in tmp_path.iterdir()] == [film.name]
    assert film.read_bytes() == b"an earlier one"


def test_going_on_with_a_trained_agent(type_command, tmp_path):
    type_command("train.py", *QUICK)
    run = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1"
    assert type_command("train.py", *QUICK, "-i", run / "FrozenLake-v1.zip")[0] == 0
    info = json.loads((run.with_name("FrozenLake-v1_2") / "run.json").read_text())
    assert info["n_timesteps"] == 1000


def test_a_budget_in_episodes(type_command, tmp_path):
    arguments = ["--algo", "sarsa", "--env", "FrozenLake-v1", "--seed", "0", "--n-episodes", "70"]
    assert type_command("train.py", *arguments, "-params", "n_envs:3")[0] == 0
    run = tmp_path / "logs" / "sarsa" / "FrozenLake-v1_1"
    rows = sum(len(path.read_text().splitlines()) - 2 for path in run.glob("*.monitor.csv"))
    # The last step may end an episode in several environments.
    assert 70 <= rows <= 72
    assert (run / "best_model.zip").exists()
    # Every four episodes, which is at most twenty times; two may end at once.
    with np.load(run / "evaluations.npz") as evaluations:
        assert 15 <= len(evaluations["timesteps"]) <= 70 // 4


def test_environment_arguments_reach_training_and_evaluation(type_command, tmp_path):
    code, _, _ = type_command(
        *("train.py", "--algo", "random", "--env", "Warehouse-v0", "-n", "1000", "--seed", "0"),
        *("--env-kwargs", "shelf_reward:-1", "max_episode_steps:50"),
        *("--eval-env-kwargs", "max_episode_steps:20"),
    )
    assert code == 0
    run = tmp_path / "logs" / "random" / "Warehouse-v0_1"
    info = json.loads((run / "run.json").read_text())
    assert info["final"]["mean_length"] <= 20
    assert info["final"]["mean_return"] >= -20
    rows = [line.split(",") for line in (run / "0.monitor.csv").read_text().splitlines()[2:]]
    assert {int(float(row[1])) for row in rows} == {50}
    assert min(float(row[0]) for row in rows) == -50


MISTAKES = {
    "environment": (["--env", "Warehose-v0"], "unknown environment 'Warehose-v0': did you mean"),
    "agent": (["--algo", "qlerning"], "unknown agent 'qlerning': did you mean 'qlearning'?"),
    "flag": (["--evn", "X"], "unknown argument --evn"),
    "value of a flag": (["-n", "many"], "must be a whole number of at least 1, or -1"),
    "hyperparameter": (["-params", "learning_rat:0.1"], "did you mean 'learning_rate'?"),
    "type": (["-params", "gamma:high"], "gamma"),
    "range": (["-params", "gamma:1.5"], "gamma"),
    "choice": (["-params", "exploration:greedy"], "exploration"),
    "spaces": (
        ["--algo", "qlearning", "--env", "MountainCarContinuous-v0"],
        "fitting agents: ppo, a2c, sac, td3, ddpg, tqc, crossq, trpo, ars, ppo_lstm, random",
    ),
    "missing file": (["--conf-file", "nowhere.yml"], "nowhere.yml"),
    "environment argument": (["--env-kwargs", "slipery:True"], "slipery"),
    "agent to go on with": (["-i", "nowhere.zip"], "no such model file: nowhere.zip"),
    "module": (["--gym-packages", "no_such_module"], "cannot import no_such_module"),
    "form of an assignment": (["-params", "learning_rate"], "learning_rate"),
    "TensorBoard's folder": (["-tb", "/dev/null/logs"], "Not a directory: /dev/null/logs"),
    "two budgets": (["-params", "n_episodes:5"], "not both"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_in_one_line_and_leaves_nothing(type_command, tmp_path, mistake):
    arguments, complaint = MISTAKES[mistake]
    given = [] if "--env" in arguments or "--algo" in arguments else QUICK
    code, out, err = type_command("train.py", *given, *arguments)
    assert code == 2
    assert err.count("\n") == 1
    assert err.startswith("train.py: error: ")
    assert complaint in err
    # What only the libraries can tell comes after the line that is printed before they are loaded.
    late = ("hyperparameter", "type", "range", "choice", "TensorBoard's folder")
    is_late = mistake in late
    assert out.partition("\n")[0] == ("qlearning on FrozenLake-v1, seed 0, 500 steps" * is_late)
    assert contents(tmp_path) == []


def test_a_broken_map_names_row_and_column(type_command, tmp_path):
    (tmp_path / "map.txt").write_text("S..\n.x.\n..G\n")
    code, _, err = type_command(
        "train.py", "--algo", "qlearning", "--env", "Warehouse-v0", "--env-kwargs", "desc:map.txt"
    )
    assert code == 2
    assert "row 2" in err
    assert "column 2" in err
    assert contents(tmp_path) == ["map.txt"]


def test_broken_yaml_names_the_line(type_command, tmp_path):
    (tmp_path / "broken.yml").write_text("FrozenLake-v1:\n  gamma: [1\n  policy: x\n")
    code, _, err = type_command("train.py", *QUICK, "--conf-file", "broken.yml")
    assert code == 2
    assert re.search(r"broken\.yml:\d+:\d+: ", err)
    assert contents(tmp_path) == ["broken.yml"]


def test_settings_that_the_library_refuses_leave_no_folder(type_command, tmp_path):
    code, _, err = type_command(
        "train.py", "--algo", "ppo", "--env", "CartPole-v1", "-params", "n_steps:1", "n_envs:1"
    )
    assert code == 2
    assert err.count("\n") == 1
    assert contents(tmp_path) == []


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([*QUICK, "-params", "engine:compiled", "--vec-env", "subproc"], "is not DummyVecEnv"),
        (
            ["--algo", "optimal", "--env", "CliffWalking-v1", "--conf-file", "plain.yml"],
            "needs a time limit",
        ),
    ],
)
def test_what_an_agent_cannot_work_with_leaves_nothing(
    type_command, tmp_path, arguments, complaint
):
    plain = tmp_path / "plain.yml"
    plain.write_text("CliffWalking-v1: {n_timesteps: 10, policy: ActionTablePolicy}\n")
    code, _, err = type_command("train.py", *arguments)
    assert (code, err.count("\n")) == (2, 1)
    assert complaint in err
    assert contents(tmp_path) == ["plain.yml"]


def damaged_zips(folder, whole):
    (folder / "truncated.zip").write_bytes(whole.read_bytes()[:-200])
    (folder / "text.zip").write_text("not a zip")
    with zipfile.ZipFile(folder / "other.zip", "w") as archive:
        archive.writestr("readme.txt", "hello")
    return {
        "truncated.zip": "no whole zip of an agent",
        "text.zip": "no whole zip of an agent",
        "other.zip": "no whole zip of an agent",
        "missing.zip": "no such model file",
    }


def test_wrong_model_files(type_command, tmp_path):
    type_command("train.py", *QUICK)
    whole = tmp_path / "logs" / "qlearning" / "FrozenLake-v1_1" / "FrozenLake-v1.zip"
    for name, complaint in damaged_zips(tmp_path, whole).items():
        code, _, err = type_command("enjoy.py", name, "--algo", "qlearning", "--render", "none")
        assert (code, err.count("\n")) == (2, 1)
        assert complaint in err
    code, _, err = type_command("enjoy.py", whole, "--algo", "sarsa", "--render", "none")
    assert code == 2
    assert "cannot be loaded as a sarsa agent" in err
    code, _, err = type_command("train.py", "--algo", "sarsa", *QUICK[2:], "-i", whole)
    assert code == 2
    assert "cannot be loaded as a sarsa agent" in err
    assert not (tmp_path / "logs" / "sarsa" / "FrozenLake-v1_1").exists()


def test_nothing_to_play(type_command):
    code, _, err = type_command("enjoy.py", "--algo", "dqn", "--env", "CartPole-v1")
    assert code == 2
    assert "train one with: python train.py --algo dqn --env CartPole-v1" in err
    code, _, err = type_command("enjoy.py", "--record", "film.avi")
    assert code == 2
    assert ".gif or .mp4" in err


@pytest.mark.parametrize(
    ("choice", "complaint"),
    [
        (["--load-best"], "holds no best_model.zip: its training may not have ended"),
        (["--load-checkpoint", "7"], "holds no rl_model_7_steps.zip: its training may not have"),
        (["--load-last-checkpoint"], "holds no checkpoint: train with --save-freq"),
        (["--exp-id", "9"], "9"),
    ],
)
def test_what_a_run_does_not_hold(type_command, choice, complaint):
    type_command("train.py", *QUICK, "--eval-freq", "-1")
    code, out, err = type_command("enjoy.py", *QUICK[:4], "--render", "none", *choice)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert complaint in err


def test_a_library_zip_from_elsewhere_is_played(type_command, tmp_path):
    from stable_baselines3 import PPO

    path = tmp_path / "foreign.zip"
    PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8).save(path)
    words = ["enjoy.py", path, "--algo", "ppo", "--env", "CartPole-v1", "--render", "none"]
    code, _, err = type_command(*words, "--trust")
    assert (code, err.count("\n")) == (2, 1)
    assert "unknown argument --trust: it is not needed" in err
    code, out, _ = type_command(*words, "--n-episodes", "2")
    assert code == 0
    assert "over 2 episodes" in out


def test_a_log_folder_that_cannot_be_written(type_command, tmp_path):
    (tmp_path / "logs").write_text("a file is in the way")
    code, _, err = type_command("train.py", *QUICK)
    assert (code, err.count("\n")) == (2, 1)
    assert "cannot make a run folder in logs/qlearning" in err


def test_a_file_of_one_default_entry_is_enough(type_command, monkeypatch, tmp_path):
    """For listing, training, playing and comparing."""
    folder = tmp_path / "hyperparams"
    folder.mkdir()
    (folder / "qlearning.yml").write_text("default:\n  n_timesteps: 60\n  policy: QTablePolicy\n")
    monkeypatch.setattr(hyperparams, "_FOLDER", folder)
    code, out, err = type_command("train.py", "--list")
    assert (code, err) == (0, "")
    assert "qlearning" in out
    choice = ["--algo", "qlearning", "--env", "FrozenLake-v1"]
    assert type_command("train.py", *choice, "--seed", "0")[::2] == (0, "")
    code, out, err = type_command("enjoy.py", *choice, "--render", "none", "--n-episodes", "2")
    assert (code, err) == (0, "")
    agent = AgentSpec("qlearning", "qlearning")
    study = StudySpec("s", "S", (agent,), (EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1"),))
    assert plan(study, tmp_path)[0].spec.hyperparams.n_timesteps == 60


def test_where_tensorboard_is_missing_it_is_named_beforehand(type_command, tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *more: None if name == "tensorboard" else find(name, *more),
    )
    code, out, err = type_command("train.py", *QUICK, "-tb", "curves")
    assert (code, out) == (2, "")
    assert err == "train.py: error: -tb needs: pip install 'rl-yardstick[tensorboard]'\n"
    assert contents(tmp_path) == []


def test_the_head_says_what_auto_stands_for_and_what_a_discount_costs(type_command, tmp_path):
    slipping = ["--algo", "qlearning", "--env", "Warehouse-v0", "--env-kwargs", "slip:0.2"]
    code, out, _ = type_command("train.py", *slipping, "-n", "500", "--seed", "0")
    assert code == 0
    assert "gamma=0.9995 (auto: 1 - 1/(2 x time limit of 1,000))" in " ".join(out.split())
    assert "exact planning" not in out
    run = tmp_path / "logs" / "qlearning" / "Warehouse-v0_1"
    spec = json.loads((run / "run.json").read_text())["spec"]
    assert (spec["hyperparams"]["gamma"], *spec["origins"]) == (0.9995, "gamma", "learning_rate")
    assert yaml.safe_load((run / "Warehouse-v0" / "config.yml").read_text())["gamma"] == 0.9995
    code, out, _ = type_command(
        *("train.py", *slipping, "-n", "500", "--seed", "0", "-params", "gamma:0.99")
    )
    assert code == 0
    assert "at gamma 0.99 even exact planning scores 0.00 here; 0.9995: 1.00" in out


def test_typed_arguments_of_the_environment_win_over_what_an_entry_trains_on():
    words = ["--algo", "ppo", "--env", "MineMaze-v0", "--env-kwargs", "mine_reward:-1"]
    spec = train_spec(build_parser().parse_args(words))
    variant = {"random_start": True, "goal_reward": 20, "power_reward": 3}
    both = [*words[:4], "-params", "env_kwargs:{'mine_reward': -1}", "--env-kwargs", "slip:0.1"]
    asked = {**variant, "mine_reward": -1, "slip": 0.1}
    assert training_kwargs(train_spec(build_parser().parse_args(both))) == asked
    compared = ["--env", "MineMaze-v0", "--algos", "ppo", *both[4:]]
    study = study_spec(compare.build_parser().parse_args(compared))
    assert training_kwargs(plan(study, Path("nowhere"))[0].spec) == asked
    assert training_kwargs(spec) == {**variant, "mine_reward": -1}
    assert "without mine_reward: -20" in spec.origins["train_env_kwargs"]
    assert training_kwargs(train_spec(build_parser().parse_args(words[:4])))["mine_reward"] == -20

"""From flags to specifications: a flag reaches the field that has its name."""

from dataclasses import fields
from pathlib import Path

import pytest

from commands import compare, enjoy, train
from commands.compare import study_spec
from commands.enjoy import model_request
from commands.train import train_spec
from experiments.study_plan import plan
from experiments.study_spec import StudySpec
from pipeline.environments import training_changes
from pipeline.errors import UserError
from pipeline.train_spec import TrainSpec

TRAIN = ["--algo", "qlearning", "--env", "FrozenLake-v1", "-n", "60"]
COMPARE = ["--algos", "qlearning", "--env", "FrozenLake-v1", "-n", "60"]


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (["--seed", "7"], "seed", 7),
        (["--eval-freq", "-1"], "eval_freq", -1),
        (["--eval-episodes", "3"], "eval_episodes", 3),
        (["--eval-episodes", "3"], "final_episodes", 3),
        (["--n-eval-envs", "2"], "n_eval_envs", 2),
        (["--save-freq", "9"], "save_freq", 9),
        (["--vec-env", "subproc"], "vec_env", "subproc"),
        (["--device", "cpu"], "device", "cpu"),
        (["--num-threads", "2"], "num_threads", 2),
        (["--log-interval", "4"], "log_interval", 4),
        (["--verbose", "0"], "verbose", 0),
        (["--progress"], "progress", True),
        (["--uuid"], "unique_id", True),
    ],
)
def test_a_flag_of_train_reaches_the_specification(words, name, value):
    args = train.build_parser().parse_args([*TRAIN, *words])
    assert getattr(train_spec(args), name) == value


def test_the_page_that_plays_a_training(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def spec_of(*words):
        return train_spec(train.build_parser().parse_args([*TRAIN, *words]))

    page = ("--watch-learning", "page.html")
    assert (spec_of(*page).watch_learning, spec_of(*page).watch_episodes) == (Path("page.html"), 0)
    assert spec_of(*page, "--watch-episodes", "3").watch_episodes == 3
    for words, complaint in [
        (("--watch-episodes", "3"), "says how much --watch-learning shows: give that too"),
        (("--watch-learning", "page.pdf"), "writes a .html file, not 'page.pdf'"),
        (("--watch-learning", "no/page.html"), "there is no folder no"),
        (("--watch-learning", "/proc/page.html"), "nothing can be written in /proc: No such file"),
    ]:
        with pytest.raises(UserError, match=complaint):
            spec_of(*words)
    (tmp_path / "page.html").mkdir()
    with pytest.raises(UserError, match=r"page\.html is a folder"):
        spec_of(*page)


def test_without_flags_a_run_is_the_default_one():
    spec = train_spec(train.build_parser().parse_args(TRAIN))
    own = {"algo", "env_id", "hyperparams", "saved_hyperparams", "seed"}
    # A study has the same number of episodes in all its runs; a run by itself as few as will do.
    assert (spec.eval_episodes, spec.final_episodes) == (None, None)
    own |= {"eval_episodes", "final_episodes", "origins"}
    assert {
        key.name: getattr(spec, key.name) for key in fields(TrainSpec) if key.name not in own
    } == {key.name: key.default for key in fields(TrainSpec) if key.name not in own}


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (["--seeds", "3"], "n_seeds", 3),
        (["--metric", "best"], "metric", "best"),
        (["--margin", "0.5"], "margin", 0.5),
        (["--episodes-table", "5"], "episodes_table", 5),
        (["--render-every", "6"], "render_every", 6),
        (["--watch-learning"], "learning_pages", True),
        ([], "figures", ("png", "svg")),
        (["--figures", "pdf", "png"], "figures", ["pdf", "png"]),
        (["--name", "mine"], "name", "mine"),
        (["--quick"], "is_quick", True),
        (["--quick"], "n_seeds", 2),
        ([], "is_quick", False),
        ([], "n_seeds", StudySpec.n_seeds),
        ([], "metric", "final"),
    ],
)
def test_a_flag_of_compare_reaches_the_study(words, name, value):
    study = study_spec(compare.build_parser().parse_args([*COMPARE, *words]))
    assert getattr(study, name) == value


def test_everybody_is_trained_on_the_environment_as_it_comes(tmp_path):
    words = ["--env", "Warehouse-v0", "--algos", "ppo", "qlearning"]
    for flags, changed in ((), {"ppo"}), (["--as-it-comes"], set()):
        study = study_spec(compare.build_parser().parse_args([*words, *flags]))
        planned = plan(study, tmp_path)
        assert {one.agent for one in planned if training_changes(one.spec)} == changed


def test_what_a_study_says_of_its_runs_reaches_them(tmp_path):
    study = StudySpec(
        "s",
        "S",
        study_spec(compare.build_parser().parse_args(COMPARE)).agents,
        study_spec(compare.build_parser().parse_args(COMPARE)).environments,
        n_seeds=1,
        eval_freq=11,
        eval_episodes=13,
        gym_packages=("gymnasium",),
    )
    (planned,) = plan(study, tmp_path)
    spec = planned.spec
    assert (spec.eval_freq, spec.eval_episodes, spec.gym_packages) == (11, 13, ("gymnasium",))


@pytest.mark.parametrize(
    ("words", "which"),
    [
        ([], "final"),
        (["--load-best"], "best"),
        (["--load-checkpoint", "500"], 500),
        (["--load-checkpoint", "0"], 0),
        (["--load-last-checkpoint"], "last checkpoint"),
    ],
)
def test_which_model_is_played(words, which):
    assert model_request(enjoy.build_parser().parse_args(words)).which == which

"""From flags to specifications: what values mean, what is refused, and the flags of rl_zoo3."""

import re

import pytest

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.commands import compare, train
from rl_yardstick.commands.compare import study_spec
from rl_yardstick.commands.train import spec_from_flags
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.study import StudySpec
from rl_yardstick.pipeline.environments import training_changes
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.spec import TrainSpec

LAKE = ["--env", "FrozenLake-v1"]


def trained(*words):
    return spec_from_flags(train.build_parser().parse_args([*LAKE, *words]))


def compared(*words):
    return study_spec(compare.build_parser().parse_args(list(words)))


SHORT = ["--algo", "qlearning", "-n", "60"]
PAIR = [*LAKE, "--algos", "qlearning", "-n", "60"]


def test_flags_of_train_reach_the_specification():
    given = {"seed": 7, "eval_freq": -1, "eval_episodes": 3, "n_eval_envs": 2, "save_freq": 9}
    given |= {"vec_env": "subproc", "device": "cpu", "log_interval": 4}
    words = [f"--{name}={value}".replace("_", "-") for name, value in given.items()]
    spec = trained(*SHORT, *words, "--verbose", "2", "--num-threads", "2")
    given |= {"library_log": True, "n_threads": 2, "final_episodes": 3}
    assert {name: getattr(spec, name) for name in given} == given
    kwargs = ["--env-kwargs", "slip:0.1", "--eval-env-kwargs", "slip:0.2", "max_episode_steps:9"]
    found = trained("--env", "Warehouse-v0", *SHORT, *kwargs)
    told = found.env_kwargs, found.eval_env_kwargs
    assert told == ({"slip": 0.1}, {"slip": 0.2, "max_episode_steps": 9})
    # Without flags a run is the default one.
    own = {"algo", "env_id", "algorithm", "n_timesteps", "seed", "origins"}
    others = {k: f.default for k, f in TrainSpec.model_fields.items() if k not in own}
    spec = trained(*SHORT)
    assert {name: getattr(spec, name) for name in others} == others


def test_flags_of_compare_reach_the_study(tmp_path):
    usual = {"figures": ("png", "svg"), "is_quick": False, "metric": "final"}
    usual |= {"n_seeds": StudySpec.n_seeds}
    study = compared(*PAIR)
    assert {name: getattr(study, name) for name in usual} == usual
    given = {"n_seeds": 3, "metric": "best", "margin": 0.5, "episodes_table": 5, "render_every": 6}
    given |= {"name": "mine", "learning_pages": True, "figures": ("pdf", "png")}
    words = "--seeds 3 --metric best --margin 0.5 --episodes-table 5 --render-every 6 --name mine"
    study = compared(*PAIR, *words.split(), "--watch-learning", "--figures", "pdf", "png")
    assert {name: getattr(study, name) for name in given} == given
    quick = compared(*PAIR, "--quick")
    assert (quick.is_quick, quick.n_seeds) == (True, 2)
    shorter = ["--quick", "-n", "300000", "--env", "MineMaze-v0"]
    planned = plan(compared(*shorter, "--algos", "ppo", "qlearning", "random"), tmp_path)
    budgets = {run.agent: run.spec.n_timesteps for run in planned}
    assert budgets == {"ppo": 20_000, "qlearning": 200_000, "random": 20_000}
    assert planned[0].spec.algorithm["engine"] == "auto"
    assert compared(*shorter, "Taxi-v4", "--algos", *list(ALGORITHMS)[:6]).n_seeds == 1
    words = ["--env", "Warehouse-v0", "--algos", "ppo", "qlearning"]
    for flags, changed in ((), {"ppo"}), (["--as-it-comes"], set()):
        planned = plan(compared(*words, *flags), tmp_path)
        assert {one.agent for one in planned if training_changes(one.spec)} == changed


def test_the_file_of_a_map_is_in_the_titles_and_not_in_the_folders(tmp_path):
    path = tmp_path / "depot.txt"
    path.write_text("S.\n.G\n")
    place = ["--env", "Warehouse-v0", "--env-kwargs", f"desc:{path}"]
    study = compared(*place, "--algos", "qlearning", "-n", "60")
    assert study.title == "qlearning on Warehouse-v0 (depot.txt)"
    first = plan(study, tmp_path)[0]
    assert first.environment == "Warehouse-v0 (depot.txt)"
    assert (first.path.name, first.spec.map_name) == ("Warehouse-v0_1", "depot.txt")
    assert trained(*SHORT, *place).map_name == "depot.txt"


MEANINGS = [
    (train, "-n", {"1e5": 100_000, "100_000": 100_000, "-1": -1}, "0 -5 1.5 nan inf text 1e13"),
    (train, "--seed", {"-1": -1, "0": 0, "4294967295": 2**32 - 1}, "-7 4294967296 1.5"),
    (train, "--eval-freq", {"-1": -1, "0": 0, "-3": -3, "1e4": 10_000}, "1.5 nan"),
    (train, "--num-threads", {"-1": -1, "4": 4}, "-2 1025 text"),
    (compare, "--seeds", {"1e1": 10}, "0 -1 1000001"),
    (compare, "--margin", {"0": 0.0, "0.5": 0.5}, "-1 nan inf"),
    (compare, "--name", {"my study": "my study"}, ".. a/b / CON a:b nul.txt"),
]


@pytest.mark.parametrize(("module", "flag", "taken", "refused"), MEANINGS)
def test_what_a_value_means(module, flag, taken, refused):
    parser = module.build_parser()
    (name,) = (a.dest for a in parser._actions if flag in a.option_strings)
    for text, value in taken.items():
        for words in ([f"{flag}={text}"], *([] if text.startswith("-") else [[flag, text]])):
            assert getattr(parser.parse_args(words), name) == value
    for text in refused.split():
        with pytest.raises(UserError, match=re.escape(f"not {text!r}")):
            parser.parse_args([f"{flag}={text}"])


ENGINES = [
    ("ppo", None),
    ("ppo --engine auto -params engine:auto gamma:0.9", "auto"),
    ("double_dqn --engine compiled", "compiled"),
    ("qlearning --engine interpreted", "interpreted"),
    ("qrdqn --engine library -n 10", None),
]


def test_an_engine_is_a_setting_where_there_is_a_choice(tmp_path):
    for words, engine in ENGINES:
        assert trained("--algo", *words.split()).algorithm.get("engine") == engine, words
    words = ["--algos", "qlearning", "ppo", "optimal", "--engine", "auto", "-n", "9"]
    planned = plan(compared(*LAKE, *words), tmp_path)
    engines = {run.agent: run.spec.algorithm.get("engine") for run in planned}
    assert engines == {"qlearning": "auto", "ppo": "auto", "optimal": None}
    headline = "studies/library-vs-hand-rolled.yml"
    for words, expected in (((), {"auto", None}), (("--engine", "compiled"), {"compiled"})):
        agents = compared(headline, *words).agents
        assert {agent.settings.get("engine") for agent in agents} == expected


# What may be typed beside --resume: nothing that the run has already, not even as it has it.
ALLOWED = {"--gym-packages": "math", "--log-folder": "logs", "--verbose": "0", "--progress": None}
ALLOWED |= {"--track": None, "--wandb-project-name": "a", "--wandb-entity": "b"}
ALLOWED |= {"--wandb-group": "c", "--wandb-tags": "d"}
OTHERS = {"--engine": "auto", "--hyperparams": "gamma:0.9", "--eval-freq": "5", "--trial-id": "5"}
OTHERS |= {"--eval-episodes": "5", "--env-kwargs": "a:1", "--eval-env-kwargs": "a:1"}


def test_every_flag_beside_resume(typed, own_folder):
    (own_folder / "run").mkdir()
    for action in train.build_parser()._actions:
        flag = action.option_strings[-1]
        if flag in ("--help", "--list", "--resume"):
            continue
        value = ALLOWED.get(flag, OTHERS.get(flag, str(action.default)))
        words = [flag] if action.nargs == 0 else [flag, value]
        said = typed.refused("train.py", "--resume", "run", *words)
        refusal = f"{flag} cannot be given with --resume: the run has its own"
        assert (refusal in said) == (flag not in ALLOWED), said
    assert not list((own_folder / "run").iterdir())

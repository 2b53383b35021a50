"""``--engine``: what it makes of trainings, studies and searches, what it refuses, what is said."""

import json
import re

import pytest
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from agents.networks import engine_setting
from agents.networks.engine_setting import TOO_SHORT, EnginePlan, Work
from commands import compare, train, tune
from commands.compare import study_spec
from commands.terminal import about, search_line, study_line, training_line
from commands.train import train_spec
from commands.tune import tuning_spec
from experiments.plan import plan
from pipeline.errors import UserError
from pipeline.model_card import card
from pipeline.preparation import EngineOutlook, planned_outlook
from tuning.retesting import Candidate, retest_study
from tuning.suggesting import planned_run

ENV = ["--env", "FrozenLake-v1"]


def trained(*words):
    return train_spec(train.build_parser().parse_args([*ENV, *words]))


def compared(*words):
    return study_spec(compare.build_parser().parse_args(list(words)))


def tuned(*words):
    return tuning_spec(tune.build_parser().parse_args([*ENV, *words]))


@pytest.mark.parametrize(
    ("algo", "words", "engine"),
    [
        ("ppo", [], None),
        ("ppo", ["--engine", "auto"], "auto"),
        ("ppo", ["--engine", "library"], "library"),
        ("ppo", ["--engine", "auto", "-params", "engine:auto", "gamma:0.9"], "auto"),
        ("double_dqn", ["--engine", "compiled"], "compiled"),
        ("qlearning", ["--engine", "interpreted"], "interpreted"),
        ("semi_gradient_q", ["--engine", "auto"], "auto"),
        ("optimal", ["--engine", "auto", "-n", "10"], None),
        ("random", ["--engine", "auto", "-n", "10"], None),
        ("qrdqn", ["--engine", "library", "-n", "10"], None),
    ],
)
def test_train(algo, words, engine):
    assert trained("--algo", algo, *words).hyperparams.algorithm.get("engine") == engine


REFUSED = [
    ("ppo", ["--engine", "auto", "-params", "engine:compiled"],
     "--engine auto and -params engine:compiled disagree: give one of them"),
    ("qlearning", ["--engine", "library"],
     "--engine library: qlearning has the engines auto, compiled, interpreted"),
    ("ppo", ["--engine", "interpreted"],
     "--engine interpreted: ppo has the engines library, compiled, auto"),
    ("qrdqn", ["--engine", "compiled"],
     "--engine compiled: qrdqn has one engine, which auto means"),
    ("optimal", ["--engine", "compiled"],
     "--engine compiled: optimal has one engine, which auto means"),
]  # fmt: skip


@pytest.mark.parametrize(("algo", "words", "complaint"), REFUSED)
def test_what_is_refused_by_every_command(algo, words, complaint):
    for ask in (
        lambda: trained("--algo", algo, "-n", "10", *words),
        lambda: (
            compared(*ENV, "--algos", "sarsa", algo, "-n", "10", *words[2:], *words[:2])
            if words[1] == "auto"
            else compared(*ENV, "--algos", algo, "-n", "10", *words)
        ),
        lambda: tuned("--algo", algo, "-n", "10", *words),
    ):
        with pytest.raises(UserError, match=f"^{re.escape(complaint)}$"):
            ask()


def test_compare_reaches_every_agent_and_a_study_file_too(tmp_path):
    study = compared(*ENV, "--algos", "qlearning", "ppo", "optimal", "--engine", "auto", "-n", "9")
    planned = plan(study, tmp_path)
    engines = {run.agent: run.spec.hyperparams.algorithm.get("engine") for run in planned}
    assert engines == {"qlearning": "auto", "ppo": "auto", "optimal": None}
    headline = compared("studies/library-vs-hand-rolled.yml")
    engines = {agent.label: agent.settings.get("engine") for agent in headline.agents}
    assert engines["double_dqn"] == "library"
    assert {engines[name] for name in ("dqn", "ppo", "qlearning")} == {None}
    faster = compared("studies/library-vs-hand-rolled.yml", "--engine", "auto")
    assert {agent.settings["engine"] for agent in faster.agents} == {"auto"}


@pytest.mark.parametrize(
    ("words", "search", "retest"),
    [
        (["--algo", "ppo"], "auto", None),
        (["--algo", "ppo", "--engine", "auto"], "auto", "auto"),
        (["--algo", "ppo", "--engine", "library"], "library", "library"),
        (["--algo", "ppo", "-params", "engine:compiled"], "compiled", "compiled"),
        (["--algo", "double_dqn"], None, None),
        (["--algo", "qlearning"], None, None),
    ],
)
def test_a_search_runs_on_auto_and_is_tested_again_as_it_will_be_used(
    words, search, retest, tmp_path
):
    tuning = tuned(*words)
    entry = {"n_timesteps": 10, **tuning.agent.settings}
    run = planned_run(tuning, tmp_path, entry, seed=0)
    assert run.spec.hyperparams.algorithm.get("engine") == search
    study = retest_study(tuning, tmp_path, [Candidate(1, entry, 0.5)])
    engines = {r.spec.hyperparams.algorithm.get("engine") for r in plan(study, tmp_path)}
    assert engines == {retest}
    # Another engine makes another search; where there is none to choose, an old one goes on.
    assert tuning.identity(entry, {}).get("search_engine") == (None if retest else search)


# --- what is said before a training ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.4, "less than 1 s"),
        (4.4, "about 4 s"),
        (119, "about 119 s"),
        (150, "about 2 min"),
        (7200, "about 2 h"),
    ],
)
def test_times_that_are_roughly_known(seconds, words):
    assert about(seconds) == words


COMPILED, LIBRARY = EnginePlan(is_compiled=True, world=(1, 2)), EnginePlan(is_compiled=False)
BRIDGED = EnginePlan(is_compiled=True, in_python="Mine must be asked after each step")
SHORT = EnginePlan(is_compiled=False, reason=TOO_SHORT)
# 10,000 updates of 2 ms, as many calls of 0.3 ms, and steps of 0.05 ms; 10 rows each, compiled.
WORK = Work("q", 10_000, 1, 10_000, 1000, 4, 0, 0)
SECONDS = {"library": 23.5, "compiled": 1.515, "bridged": 2.515}


class Mine(BaseCallback):
    def _on_step(self):
        return True


@pytest.fixture
def a_warm_machine(monkeypatch):
    """One of the pace of that on which the constants were measured."""
    monkeypatch.setattr(engine_setting, "machine_pace", lambda: 1.0)
    monkeypatch.setattr(engine_setting, "is_compiled_before", lambda name: True)


def test_seconds_by_hand():
    assert {name: getattr(WORK, f"{name}_seconds") for name in SECONDS} == pytest.approx(SECONDS)


LOOP = "library (Stable-Baselines3's own loop)"
HEADS = [  # the engine, that of auto, callbacks, and the line
    (LIBRARY, COMPILED, [],
     (f"{LOOP}, about 24 s of processor time; --engine auto: the same networks and updates "
      "compiled, about 2 s")),
    (COMPILED, COMPILED, [],
     "compiled, about 2 s of processor time (Stable-Baselines3's own loop: about 24 s)"),
    (SHORT, SHORT, [],
     f"{LOOP}, about 24 s of processor time: {TOO_SHORT}"),
    (LIBRARY, SHORT, [], f"{LOOP}, about 24 s of processor time"),
    (BRIDGED, BRIDGED, [Mine()],
     ("compiled but for the environment, about 3 s of processor time: Mine must be asked after "
      "each step (Stable-Baselines3's own loop: about 24 s); made a BlockCallback, it would be "
      "asked only when it acts (docs/training.md#from-python), and training take about 2 s")),
]  # fmt: skip


@pytest.mark.usefixtures("a_warm_machine")
@pytest.mark.parametrize("case", range(len(HEADS)))
def test_the_head_of_a_training(case):
    chosen, auto, callbacks, line = HEADS[case]
    outlook = EngineOutlook(chosen, auto, WORK)
    assert training_line(outlook, None, CallbackList(callbacks)) == line


@pytest.mark.usefixtures("a_warm_machine")
def test_the_head_where_nobody_knows_how_long_a_step_takes():
    outlook = EngineOutlook(LIBRARY, EnginePlan(is_compiled=True, in_python="no model"), None)
    assert training_line(outlook, None, CallbackList([])) == (
        "library (Stable-Baselines3's own loop); --engine auto: the same networks and updates "
        "compiled but for the environment (no model)"
    )


def test_compiling_is_told_where_it_is_still_to_be_done(monkeypatch):
    monkeypatch.setattr(engine_setting, "machine_pace", lambda: 1.0)
    monkeypatch.setattr(engine_setting, "is_compiled_before", lambda name: False)
    line = training_line(EngineOutlook(COMPILED, COMPILED, WORK), None, CallbackList([]))
    assert line.startswith(
        "compiled, about 2 s of processor time and once about 9 s of compiling ("
    )


@pytest.mark.usefixtures("a_warm_machine")
def test_the_head_of_a_study():
    ppo, double = EngineOutlook(LIBRARY, COMPILED, WORK), EngineOutlook(COMPILED, COMPILED, WORK)
    assert study_line([("ppo", ppo, 10), ("dqn", ppo, 10), ("double_dqn", double, 4)]) == (
        "ppo, dqn: library (Stable-Baselines3's own loop), about 8 min of processor time in 20 "
        "runs; with --engine auto compiled, about 30 s; double_dqn: compiled, about 6 s of "
        "processor time in 4 runs"
    )
    assert study_line([]) == ""


@pytest.mark.usefixtures("a_warm_machine")
def test_the_head_of_a_search():
    search, retest = EngineOutlook(COMPILED, COMPILED, WORK), EngineOutlook(LIBRARY, COMPILED, WORK)
    assert search_line("ppo", search, retest) == (
        "search: compiled, about 2 s of processor time a run; re-test: library "
        "(Stable-Baselines3's own loop), about 24 s a run, in which train runs ppo; --engine auto "
        "re-tests compiled, for who trains so"
    )
    assert search_line("ppo", search, search) == (
        "search and re-test: compiled, about 2 s of processor time a run"
    )
    assert search_line("qlearning", None, None) == ""


@pytest.mark.parametrize(
    ("algo", "settings", "chosen"),
    [
        ("ppo", [], "library"),
        ("ppo", ["--engine", "auto"], "compiled"),
        ("ppo", ["--engine", "auto", "-n", "1000"], f"library: {TOO_SHORT}"),
        ("double_dqn", [], "compiled"),
        ("double_dqn", ["--n-episodes", "5"], f"library: {TOO_SHORT}"),
        ("dqn", ["--engine", "auto", "-params", "mask_actions:true"], "library: it masks actions"),
    ],
)
def test_what_a_planned_run_will_train_on(algo, settings, chosen):
    spec = trained("--env", "Warehouse-v0", "--algo", algo, *settings)
    assert str(planned_outlook(spec).plan) == chosen
    assert planned_outlook(trained("--algo", "qlearning")) is None


def test_a_run_says_and_records_what_it_trains_on(type_command, tmp_path):
    words = ["--algo", "ppo", *ENV, "-n", "200", "--seed", "0", "--eval-freq", "-1"]
    settings = ["-params", "n_steps:64", "n_envs:1", "batch_size:64"]
    code, out, err = type_command("train.py", *words, "--engine", "auto", *settings)
    assert (code, err) == (0, "")
    heads = [line for line in out.splitlines() if line.startswith("engine  library (")]
    assert len(heads) == 1
    assert heads[0].endswith(TOO_SHORT)
    path = tmp_path / "logs" / "ppo" / "FrozenLake-v1_1" / "run.json"
    record = json.loads(path.read_text())
    assert record["engine"] == f"library: {TOO_SHORT}"
    assert record["spec"]["hyperparams"]["engine"] == "auto"
    assert f"engine: library: {TOO_SHORT}" in card(record, [])


def test_a_table_says_what_a_callback_costs(type_in_own_folder, own_folder):
    (own_folder / "each_step.py").write_text(
        "from stable_baselines3.common.callbacks import BaseCallback\n"
        "class Mine(BaseCallback):\n    def _on_step(self):\n        return True\n"
    )
    words = ["--algo", "qlearning", *ENV, "-n", "100", "--gym-packages", "each_step"]
    _, out, err = type_in_own_folder("train.py", *words, "-params", "callback:each_step.Mine")
    assert err == ""
    assert (
        "engine  interpreted, about a hundred times slower or more: Mine must be asked after each "
        "step; made a BlockCallback, it would be asked only when it acts "
        "(docs/training.md#from-python)"
    ) in out.splitlines()

"""From a study to its runs: folders, seeds, settings, and what makes a run the same run."""

import json
from dataclasses import MISSING, fields, replace
from pathlib import Path

import pytest

from experiments.plan import TuningSeeds, check_settings, plan, tuning_seeds
from experiments.study import AS_IT_COMES, AgentSpec, EnvironmentSpec, StudySpec
from pipeline.digests import DamagedFileError
from pipeline.errors import UserError
from pipeline.runs import FAILED, FINISHED
from pipeline.train_spec import TrainSpec
from report.words import seed_sentence, spans

LAKE = EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1", {"n_timesteps": 100})


def study_of(*agents, environments=(LAKE,), **fields):
    agents = tuple(AgentSpec(agent, agent) if isinstance(agent, str) else agent for agent in agents)
    return StudySpec("lakes", "Lakes", agents, tuple(environments), **fields)


def only(study, root=Path("nowhere")):
    (planned,) = plan(replace(study, n_seeds=1), root)
    return planned


def test_every_agent_on_every_environment_with_every_seed(tmp_path):
    dry = EnvironmentSpec("dry lake", "FrozenLake-v1", {"n_episodes": 9})
    planned = plan(study_of("qlearning", "sarsa", environments=(LAKE, dry), n_seeds=3), tmp_path)
    assert [(run.seed, run.agent, run.environment) for run in planned] == [
        (seed, agent, environment)
        for seed in range(3)
        for environment in ("FrozenLake-v1", "dry lake")
        for agent in ("qlearning", "sarsa")
    ]
    assert all(run.spec.seed == run.seed for run in planned)
    assert {run.spec.env_id for run in planned} == {"FrozenLake-v1"}
    assert len({run.path for run in planned}) == len(planned)
    # Numbers begin at 1, as those of single runs do.
    assert planned[-1].path == tmp_path / "runs" / "sarsa" / "dry_lake_3"
    assert planned[-1].run.env_name == "FrozenLake-v1"
    assert list(tmp_path.iterdir()) == []


def test_a_study_has_a_bearable_number_of_runs(monkeypatch):
    monkeypatch.setattr("experiments.plan.MOST_RUNS", 6)
    dry = EnvironmentSpec("dry lake", "FrozenLake-v1", {"n_episodes": 9})
    study = study_of("qlearning", "sarsa", "dqn", environments=(LAKE, dry), n_seeds=1)
    assert len(plan(study, Path("nowhere"))) == 6
    with pytest.raises(UserError) as caught:
        plan(replace(study, n_seeds=10**12), Path("nowhere"))
    assert str(caught.value) == (
        "lakes: 3 agents on 2 environments with 1,000,000,000,000 seeds are "
        "6,000,000,000,000 runs; a study has 6 at most"
    )


def test_a_batch_has_a_bearable_number_of_pulls(monkeypatch):
    monkeypatch.setattr("pipeline.environments.memory_bytes", lambda: 10**6)
    settings = {"n_timesteps": 1000, "env_kwargs": {"pulls": 1000}}
    bandit = EnvironmentSpec("arms", "GaussianBandit-v0", settings)
    assert len(plan(study_of("ucb", environments=[bandit], n_seeds=30), Path("nowhere"))) == 1
    with pytest.raises(
        UserError, match=r"^ucb on arms: 50 seeds with n_timesteps 1,000 would take"
    ):
        plan(study_of("ucb", environments=[bandit], n_seeds=50), Path("nowhere"))


def test_labels_become_names_of_folders(tmp_path):
    agent = AgentSpec("a/b: gamma=0.9 (mine)", "qlearning")
    assert only(study_of(agent), tmp_path).path.parent.name == "a_b_gamma=0.9_mine"


@pytest.mark.parametrize(
    "labels",
    [
        ("a b", "a/b"),
        ("Mine", "mine"),
        ("same", "same"),
        ("Straße", "STRASSE"),
        ("\uf900", "\u8c48"),  # one sign under two numbers, which macOS makes one
    ],
)
def test_labels_that_would_share_a_folder(labels):
    agents = [AgentSpec(label, "qlearning") for label in labels]
    with pytest.raises(UserError, match=r"agents: .* would share the folder"):
        plan(study_of(*agents), Path())
    environments = [replace(LAKE, label=label) for label in labels]
    with pytest.raises(UserError, match=r"environments: .* would share the folder"):
        plan(study_of("sarsa", environments=environments), Path())


def test_the_agents_settings_go_over_the_environments_and_those_over_the_file():
    environment = EnvironmentSpec(
        "lake",
        "FrozenLake-v1",
        {"gamma": 0.5, "learning_rate": 0.5, "env_kwargs": {"is_slippery": False}},
    )
    agent = AgentSpec(
        "mine",
        "qlearning",
        {"learning_rate": 0.25, "n_episodes": 7, "env_kwargs": {"map_name": "8x8"}},
    )
    special = only(study_of(agent, environments=(environment,))).spec.hyperparams
    assert special.algorithm["gamma"] == 0.5
    assert special.algorithm["learning_rate"] == 0.25
    assert special.env_kwargs == {"is_slippery": False, "map_name": "8x8"}
    assert (special.n_episodes, special.n_timesteps) == (7, None)
    file = only(study_of("qlearning")).spec.saved_hyperparams
    # What neither of them mentions comes from the file.
    untouched = set(file) - {"gamma", "learning_rate", "env_kwargs", "n_timesteps"}
    assert untouched
    assert all(special.algorithm[key] == file[key] for key in untouched)


def test_untuned_agents_begin_with_their_defaults():
    agent = AgentSpec("plain", "qlearning", {"gamma": 0.9}, tuned=False)
    assert only(study_of(agent)).spec.saved_hyperparams == {"gamma": 0.9, "n_timesteps": 100}


def test_a_quick_study_has_a_share_of_the_budget():
    study = study_of("qlearning", AgentSpec("short", "sarsa", {"n_episodes": 4})).quickened()
    long, short = plan(replace(study, n_seeds=1), Path())
    assert long.spec.hyperparams.n_timesteps == 10
    assert short.spec.hyperparams.n_episodes == 1


@pytest.mark.parametrize(
    ("agent", "complaint"),
    [
        (AgentSpec("a", "qlearning", {"n_timesteps": None}), "how long to train"),
        (AgentSpec("a", "linucb"), "does not fit FrozenLake-v1"),
        (AgentSpec("a", "qlearning", {"n_envs": 0}), "n_envs"),
        (AgentSpec("a", "qlearning", {"n_timesteps": 0}), "n_timesteps"),
        (AgentSpec("a", "qlearning", {"env_kwargs": {"slipery": True}}), "slipery"),
        (AgentSpec("a", "qlearning", {"env_wrapper": "no.such.Wrapper"}), "no.such.Wrapper"),
    ],
)
def test_what_cannot_be_trained_is_refused_beforehand(tmp_path, agent, complaint):
    with pytest.raises(UserError, match=complaint) as error:
        plan(study_of("sarsa", replace(agent, where="lakes.yml:7")), tmp_path)
    assert str(error.value).startswith("lakes.yml:7: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"learning_rat": 0.1}, "did you mean 'learning_rate'?"),
        ({"gamma": 1.5}, "gamma"),
        ({"callback": "pipeline.callbacks.NoSuchCallback"}, "NoSuchCallback"),
    ],
)
def test_settings_that_the_agent_refuses_are_found_beforehand(tmp_path, settings, complaint):
    study = study_of(AgentSpec("mine", "qlearning", settings, where="lakes.yml:3"))
    with pytest.raises(UserError, match=rf"^lakes\.yml:3: .*{complaint}".replace("?", r"\?")):
        check_settings(study, plan(study, tmp_path))
    check_settings(study_of("qlearning"), plan(study_of("qlearning"), tmp_path))


@pytest.mark.parametrize("n_seeds", [1, 2, 5])
@pytest.mark.parametrize("place", [0, 1])
def test_every_agent_is_checked_however_few_its_seeds_are(tmp_path, n_seeds, place):
    agents = [AgentSpec("good", "sarsa"), AgentSpec("bad", "qlearning", {"gamma": 1.5})]
    study = study_of(*agents[:: 1 - 2 * place], n_seeds=n_seeds)
    with pytest.raises(UserError, match="gamma"):
        check_settings(study, plan(study, tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_a_batch_of_bandit_runs_is_checked_as_well(tmp_path):
    bandit = EnvironmentSpec("coins", "BernoulliBandit-v0", {"n_timesteps": 10})
    agent = AgentSpec("ucb", "ucb", {"bonus": 3, "boons": 1})
    study = study_of(agent, environments=(bandit,), n_seeds=3)
    planned = plan(study, tmp_path)
    assert [run.is_batch for run in planned] == [True]
    with pytest.raises(UserError, match="bonus"):
        check_settings(study, planned)


def record(planned, **fields):
    """What a run that has come to its end leaves."""
    planned.path.mkdir(parents=True, exist_ok=True)
    info = {"state": FINISHED, "spec": planned.spec.as_data(), **fields}
    planned.run.info_path.write_text(json.dumps(info))


def test_a_run_is_finished_where_its_folder_says_so(tmp_path):
    study = study_of("qlearning")
    planned = only(study, tmp_path)
    assert not planned.is_finished
    record(planned, state=FAILED)
    assert not planned.is_finished
    record(planned)
    assert planned.is_finished
    assert only(study, tmp_path).is_finished


@pytest.mark.parametrize(
    "changed",
    [
        study_of(AgentSpec("qlearning", "qlearning", {"gamma": 0.123})),
        study_of(AgentSpec("qlearning", "sarsa")),
        study_of("qlearning", environments=(replace(LAKE, settings={"n_timesteps": 101}),)),
        study_of("qlearning", environments=(replace(LAKE, env_id="FrozenLake8x8-v1"),)),
        study_of("qlearning", eval_freq=50),
        study_of("qlearning", eval_episodes=3),
    ],
)
def test_a_run_of_other_settings_does_not_count(tmp_path, changed):
    record(only(study_of("qlearning"), tmp_path))
    assert not only(changed, tmp_path).is_finished


def test_what_is_shown_meanwhile_is_no_part_of_a_run(tmp_path):
    planned = only(study_of("qlearning"), tmp_path)
    loud = replace(planned.spec, verbose=2, progress=True, log_interval=7, pictures=True)
    record(replace(planned, spec=loud))
    assert planned.is_finished
    logged = only(study_of("qlearning", tensorboard=True), tmp_path)
    assert logged.is_finished
    folder = tmp_path / "tensorboard" / "qlearning" / "FrozenLake-v1_1"
    assert logged.spec.tensorboard_log == folder


def test_checkpoints_are_asked_of_the_first_seed_alone(tmp_path):
    record(only(study_of("qlearning"), tmp_path))
    first, second = plan(study_of("qlearning", render_every=5, n_seeds=2), tmp_path)
    assert (first.spec.save_every_n_episodes, second.spec.save_every_n_episodes) == (5, -1)
    assert not first.is_finished
    record(first)
    assert first.is_finished
    # Without films, a run that has checkpoints is as good as one without.
    assert only(study_of("qlearning"), tmp_path).is_finished
    assert not only(study_of("qlearning", render_every=6), tmp_path).is_finished


OPTIONAL = {key.name: key.default for key in fields(TrainSpec) if key.default is not MISSING}


@pytest.mark.parametrize("name", OPTIONAL)
def test_a_field_that_came_later_counts_as_its_default(tmp_path, name):
    """So that a new field does not make finished studies run again."""
    planned = only(study_of("qlearning"), tmp_path)
    data = planned.spec.as_data()
    planned = replace(planned, spec=replace(planned.spec, **{name: OPTIONAL[name]}))
    record(planned, spec={key: value for key, value in data.items() if key != name})
    assert planned.is_finished


@pytest.mark.parametrize(
    "wanted", [{"n_eval_envs": 7}, {"eval_freq": 50}, {"vec_env": "subproc"}, {"num_threads": 2}]
)
def test_a_field_that_came_later_counts_where_it_is_not_its_default(tmp_path, wanted):
    planned = only(study_of("qlearning"), tmp_path)
    data = planned.spec.as_data()
    record(planned, spec={key: value for key, value in data.items() if key not in wanted})
    assert planned.is_finished
    assert not replace(planned, spec=replace(planned.spec, **wanted)).is_finished


def test_a_field_that_there_is_no_more_does_not_count(tmp_path):
    planned = only(study_of("qlearning"), tmp_path)
    record(planned, spec={**planned.spec.as_data(), "eval_parallel": True})
    assert planned.is_finished


@pytest.mark.parametrize("name", ["algo", "env_id", "hyperparams", "seed"])
def test_a_record_without_what_makes_a_run_is_of_another(tmp_path, name):
    planned = only(study_of("qlearning"), tmp_path)
    data = planned.spec.as_data()
    record(planned, spec={key: value for key, value in data.items() if key != name})
    assert not planned.is_finished


@pytest.mark.parametrize("spec", [None, [], "qlearning", {}])
def test_a_record_of_no_spec_is_of_another_run(tmp_path, spec):
    planned = only(study_of("qlearning"), tmp_path)
    record(planned, spec=spec)
    assert not planned.is_finished


# As the first version wrote it for one of a study's runs.
FIRST_VERSION = """{
  "state": "finished",
  "env_name": "FrozenLake-v1",
  "spec": {
    "algo": "qlearning",
    "env_id": "FrozenLake-v1",
    "seed": 0,
    "eval_freq": null,
    "eval_episodes": 20,
    "n_eval_envs": 10,
    "save_freq": -1,
    "save_every_n_episodes": -1,
    "log_folder": "logs",
    "tensorboard_log": null,
    "trained_agent": null,
    "vec_env": "dummy",
    "device": "auto",
    "num_threads": 1,
    "log_interval": -1,
    "verbose": 0,
    "progress": false,
    "gym_packages": [],
    "unique_id": false,
    "pictures": false,
    "hyperparams": {"policy": "QTablePolicy", "learning_rate": 0.5, "n_timesteps": 500}
  },
  "versions": {"python": "3.11.7", "rl-yardstick": "0.1.0", "stable-baselines3": "2.9.2"},
  "n_timesteps": 500,
  "seconds": 0.596,
  "final": {"mean_return": 0.5, "std_return": 0.5, "mean_length": 12.0, "success_rate": 0.5,
            "exact": true, "n_episodes": null},
  "best_mean_return": 0.5,
  "best_timesteps": 250,
  "engine": "compiled"
}"""


def test_a_run_of_the_first_version_is_finished(tmp_path):
    settings = {"policy": "QTablePolicy", "learning_rate": 0.5, "n_timesteps": 500}
    agent = AgentSpec("qlearning", "qlearning", settings, tuned=False)
    environment = EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1")
    planned = only(study_of(agent, environments=(environment,)), tmp_path)
    planned.path.mkdir(parents=True)
    planned.run.info_path.write_text(FIRST_VERSION)
    assert planned.is_finished
    assert not replace(planned, spec=replace(planned.spec, seed=1)).is_finished


def test_a_damaged_record_is_named(tmp_path):
    planned = only(study_of("qlearning"), tmp_path)
    record(planned)
    planned.run.info_path.write_text("{")
    assert not planned.is_finished
    assert not planned.is_to_do
    with pytest.raises(DamagedFileError, match=r"run\.json is damaged"):
        planned.check_record()


# --- Which seeds of a study its settings were tuned on, and how that is said.

TUNED_LAKE, PENDULUM = (EnvironmentSpec(name, name) for name in ("FrozenLake-v1", "Pendulum-v1"))
NONE = frozenset()


def study(*agents, places=(TUNED_LAKE,), first=0, count=10):
    return StudySpec("s", "S", agents, places, n_seeds=count, first_seed=first)


def said(*agents, **fields):
    asked = study(*agents, **fields)
    return seed_sentence(asked.seeds, tuning_seeds(asked))


DQN, PPO, RANDOM = (AgentSpec(name, name) for name in ("dqn", "ppo", "random"))


def test_the_shipped_settings_and_the_seeds_that_they_were_tuned_on():
    agents = DQN, PPO, RANDOM
    assert said(*agents) == "Seeds 0 to 9: the shipped settings of dqn and ppo were tuned on these."
    assert said(*agents, first=1000) == "Seeds 1000 to 1009: nothing was tuned on these."
    assert said(*agents, first=8) == (
        "Seeds 8 to 17: the shipped settings of dqn and ppo were tuned on 8 to 9 of these."
    )
    assert said(PPO, first=3, count=1) == "Seed 3: the shipped settings of ppo were tuned on it."
    assert said(PPO, first=33, count=1) == "Seed 33: nothing was tuned on it."


def test_each_environment_has_its_own():
    found = tuning_seeds(study(PPO, places=(PENDULUM,), first=99, count=3))
    assert found == TuningSeeds({"ppo": frozenset({100})}, {}, ())
    both = tuning_seeds(study(PPO, places=(TUNED_LAKE, PENDULUM), count=101))
    assert both.shipped == {"ppo": frozenset([*range(10), 100])}


def test_defaults_of_a_constructor_were_tuned_on_nothing_and_budgets_are_no_tuning():
    plain = replace(DQN, tuned=False, settings={"policy": "MlpPolicy", "n_timesteps": 100})
    assert said(plain) == "Seeds 0 to 9: nothing was tuned on these."
    assert "the shipped settings of dqn" in said(replace(DQN, settings={"n_timesteps": 100}))


def test_settings_of_the_studys_own_are_not_known_of():
    changed = AgentSpec("mine", "dqn", {"gamma": 0.9})
    assert said(changed, first=1000) == (
        "Seeds 1000 to 1009: nothing is known to have been tuned on these; what the study's own "
        "settings of mine were tuned on is not known."
    )
    assert said(changed) == (
        "Seeds 0 to 9: the shipped settings of dqn were tuned on these; what the study's own "
        "settings of mine were tuned on is not known."
    )
    place = replace(TUNED_LAKE, settings={"gamma": 0.9})
    assert tuning_seeds(study(DQN, RANDOM, places=(place,))).unknown == ("dqn", "random")
    sweep = [AgentSpec(f"g={g}", "dqn", {"gamma": g}, group="g") for g in (0.1, 0.2)]
    assert tuning_seeds(study(*sweep)).unknown == ("g",)


def test_files_of_ones_own_say_it_or_it_is_not_known(tmp_path):
    path = tmp_path / "mine.yml"
    agent = replace(DQN, conf_file=path)
    path.write_text("FrozenLake-v1: {gamma: 0.5}\n")
    assert said(agent) == (
        "Seeds 0 to 9: what the study's own settings of dqn were tuned on is not known."
    )
    path.write_text(
        "tuned_on: {FrozenLake-v1: {first: 5, count: 2}}\nFrozenLake-v1: {gamma: 0.5}\n"
    )
    assert said(agent) == "Seeds 0 to 9: the settings in mine.yml were tuned on 5 to 6 of these."
    assert tuning_seeds(study(agent)) == TuningSeeds({}, {"mine.yml": frozenset({5, 6})}, ())
    path.unlink()
    assert tuning_seeds(study(agent)) == TuningSeeds({}, {}, ("dqn",))


def test_an_agent_of_ones_own_is_not_known_of():
    assert tuning_seeds(study(AgentSpec("own", "own", tuned=False))) == TuningSeeds(
        {}, {}, ("own",)
    )


def test_many_names_are_cut_short():
    tuning = TuningSeeds({}, {}, tuple("abcdefgh"))
    assert "of a, b, c, d, e, f and 2 more were" in seed_sentence(range(10), tuning)
    assert seed_sentence(range(3), TuningSeeds({"a": NONE}, {}, ())).endswith(
        "nothing was tuned on these."
    )


@pytest.mark.parametrize(
    ("numbers", "text"),
    [([3], "3"), ([0, 1, 2], "0 to 2"), ([9, 0, 1, 4, 7, 8], "0 to 1, 4, 7 to 9")],
)
def test_spans(numbers, text):
    assert spans(numbers) == text


def test_nobody_tuned_on_other_arguments_of_the_environment():
    slippery = EnvironmentSpec("slip", "Warehouse-v0", {"env_kwargs": {"slip": 0.1}})
    elsewhere = "the settings of dqn were tuned with other arguments of the environment"
    assert said(DQN, places=(slippery,)) == f"Seeds 0 to 9: {elsewhere}."
    assert said(DQN, places=(slippery,), first=1000) == f"Seeds 1000 to 1009: {elsewhere}."
    assert said(RANDOM, places=(slippery,)) == "Seeds 0 to 9: nothing was tuned on these."
    both = said(DQN, places=(slippery, TUNED_LAKE))
    assert both == f"Seeds 0 to 9: the shipped settings of dqn were tuned on these; {elsewhere}."
    own = replace(DQN, settings={"env_kwargs": {"is_slippery": False}})
    assert said(own) == f"Seeds 0 to 9: {elsewhere}."
    for env_id, kwargs in (("Warehouse-v0", {"slip": 0.0}), ("RandomWarehouse-v0", {"size": 10})):
        usual = EnvironmentSpec("usual", env_id, {"env_kwargs": kwargs})
        assert "the shipped settings of dqn were tuned on these" in said(DQN, places=(usual,))
    as_it_comes = EnvironmentSpec("as it comes", "Warehouse-v0", AS_IT_COMES)
    assert said(DQN, places=(as_it_comes,)) == f"Seeds 0 to 9: {elsewhere}."
    table = AgentSpec("sarsa", "sarsa")  # which has no such changes in its settings
    assert "of sarsa were tuned on these" in said(table, places=(as_it_comes,))


def test_the_same_environment_by_another_name_was_tuned_on():
    slippery = EnvironmentSpec("ice", "CliffWalking-v1", {"env_kwargs": {"is_slippery": True}})
    table = AgentSpec("sarsa", "sarsa")
    assert said(table, places=(slippery,)) == (
        "Seeds 0 to 9: the shipped settings of sarsa were tuned on these."
    )

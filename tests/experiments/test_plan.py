"""From a study to its runs: folders, seeds, settings, what makes a run the same; tuned seeds."""

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
from report.words import seed_sentence

NOWHERE = Path("nowhere")
LAKE = EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1", {"n_timesteps": 100})
DRY = EnvironmentSpec("dry lake", "FrozenLake-v1", {"n_episodes": 9})


def study_of(*agents, environments=(LAKE,), **fields):
    agents = tuple(AgentSpec(agent, agent) if isinstance(agent, str) else agent for agent in agents)
    return StudySpec("lakes", "Lakes", agents, tuple(environments), **fields)


def only(study, root=NOWHERE):
    (planned,) = plan(replace(study, n_seeds=1), root)
    return planned


def test_every_agent_on_every_environment_with_every_seed(tmp_path):
    planned = plan(study_of("qlearning", "sarsa", environments=(LAKE, DRY), n_seeds=3), tmp_path)
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


def test_a_study_has_a_bearable_number_of_runs_and_a_batch_of_pulls(monkeypatch):
    study = study_of("qlearning", "sarsa", "dqn", environments=(LAKE, DRY), n_seeds=10**12)
    told = (
        "^lakes: 3 agents on 2 environments with 1,000,000,000,000 seeds are "
        "6,000,000,000,000 runs; a study has .* at most$"
    )
    with pytest.raises(UserError, match=told):
        plan(study, NOWHERE)
    monkeypatch.setattr("pipeline.environments.memory_bytes", lambda: 10**6)  # a small machine
    settings = {"n_timesteps": 1000, "env_kwargs": {"pulls": 1000}}
    study = study_of("ucb", environments=[EnvironmentSpec("arms", "GaussianBandit-v0", settings)])
    assert len(plan(replace(study, n_seeds=30), NOWHERE)) == 1
    with pytest.raises(UserError, match=r"^ucb on arms: 50 seeds with n_timesteps 1,000 would"):
        plan(replace(study, n_seeds=50), NOWHERE)


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
        plan(study_of(*agents), NOWHERE)
    environments = [replace(LAKE, label=label) for label in labels]
    with pytest.raises(UserError, match=r"environments: .* would share the folder"):
        plan(study_of("sarsa", environments=environments), NOWHERE)


def test_the_agents_settings_go_over_the_environments_and_those_over_the_file():
    usual = {"gamma": 0.5, "learning_rate": 0.5, "env_kwargs": {"is_slippery": False}}
    own = {"learning_rate": 0.25, "n_episodes": 7, "env_kwargs": {"map_name": "8x8"}}
    environment = EnvironmentSpec("lake", "FrozenLake-v1", usual)
    study = study_of(AgentSpec("mine", "qlearning", own), environments=(environment,))
    special = only(study).spec.hyperparams
    assert special.algorithm["gamma"] == 0.5
    assert special.algorithm["learning_rate"] == 0.25
    assert special.env_kwargs == {"is_slippery": False, "map_name": "8x8"}
    assert (special.n_episodes, special.n_timesteps) == (7, None)
    file = only(study_of("qlearning")).spec.saved_hyperparams
    # What neither of them mentions comes from the file.
    untouched = set(file) - {"gamma", "learning_rate", "env_kwargs", "n_timesteps"}
    assert untouched
    assert all(special.algorithm[key] == file[key] for key in untouched)


@pytest.mark.parametrize(
    ("algo", "settings", "complaint"),
    [
        ("qlearning", {"n_timesteps": None}, "how long to train"),
        ("linucb", {}, "does not fit FrozenLake-v1"),
        ("qlearning", {"n_envs": 0}, "n_envs"),
        ("qlearning", {"n_timesteps": 0}, "n_timesteps"),
        ("qlearning", {"env_kwargs": {"slipery": True}}, "slipery"),
        ("qlearning", {"env_wrapper": "no.such.Wrapper"}, r"no\.such\.Wrapper"),
        # What the agent itself refuses is found with the libraries.
        ("qlearning", {"learning_rat": 0.1}, r"did you mean 'learning_rate'\?"),
        ("qlearning", {"gamma": 1.5}, "gamma"),
        ("qlearning", {"callback": "pipeline.callbacks.NoSuchCallback"}, "NoSuchCallback"),
    ],
)
def test_what_cannot_be_trained_is_refused_beforehand(tmp_path, algo, settings, complaint):
    agents = AgentSpec("good", "sarsa"), AgentSpec("bad", algo, settings, where="lakes.yml:7")
    for order, n_seeds in ((agents, 1), (agents[::-1], 2)):
        study = study_of(*order, n_seeds=n_seeds)
        with pytest.raises(UserError, match=rf"^lakes\.yml:7: .*{complaint}"):
            check_settings(study, plan(study, tmp_path))
    good = study_of(agents[0])
    check_settings(good, plan(good, tmp_path))
    assert list(tmp_path.iterdir()) == []


# --- Which run it is that a folder holds.


def record(planned, **fields):
    """What a run that has come to its end leaves."""
    planned.path.mkdir(parents=True, exist_ok=True)
    info = {"state": FINISHED, "spec": planned.spec.as_data(), **fields}
    planned.run.info_path.write_text(json.dumps(info))


PLAIN = study_of("qlearning")


def test_a_run_is_finished_where_its_folder_says_so(tmp_path):
    planned = only(PLAIN, tmp_path)
    assert not planned.is_finished
    record(planned, state=FAILED)
    assert not planned.is_finished
    record(planned)
    assert planned.is_finished
    assert only(PLAIN, tmp_path).is_finished
    planned.run.info_path.write_text("{")
    assert not planned.is_finished
    assert not planned.is_to_do
    with pytest.raises(DamagedFileError, match=r"run\.json is damaged"):
        planned.check_record()


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
    ids=["setting", "algorithm", "budget", "environment", "eval_freq", "eval_episodes"],
)
def test_a_run_of_other_settings_does_not_count(tmp_path, changed):
    record(only(PLAIN, tmp_path))
    assert not only(changed, tmp_path).is_finished


def test_checkpoints_are_asked_of_the_first_seed_alone(tmp_path):
    record(only(PLAIN, tmp_path))
    first, second = plan(replace(PLAIN, render_every=5, n_seeds=2), tmp_path)
    assert (first.spec.save_every_n_episodes, second.spec.save_every_n_episodes) == (5, -1)
    assert not first.is_finished
    record(first)
    assert first.is_finished
    # Without films, a run that has checkpoints is as good as one without.
    assert only(PLAIN, tmp_path).is_finished
    assert not only(replace(PLAIN, render_every=6), tmp_path).is_finished


OPTIONAL = {key.name: key.default for key in fields(TrainSpec) if key.default is not MISSING}
OTHERWISE = {"n_eval_envs": 7, "eval_freq": 50, "vec_env": "subproc", "num_threads": 2}


def test_a_field_that_came_later_counts_as_its_default(tmp_path):
    """So that a new field does not make finished studies run again."""
    planned = only(PLAIN, tmp_path)
    data = planned.spec.as_data()
    for name, default in OPTIONAL.items():
        record(planned, spec={key: value for key, value in data.items() if key != name})
        usual = replace(planned, spec=replace(planned.spec, **{name: default}))
        assert usual.is_finished, name
        if name in OTHERWISE:
            wanted = replace(planned.spec, **{name: OTHERWISE[name]})
            assert not replace(planned, spec=wanted).is_finished, name
    record(planned, spec={**data, "eval_parallel": True})  # a field that there is no more
    assert planned.is_finished


# --- Which seeds of a study its settings were tuned on, and how that is said.

TUNED_LAKE, PENDULUM = (EnvironmentSpec(name, name) for name in ("FrozenLake-v1", "Pendulum-v1"))
DQN, PPO, RANDOM, TABLE = (AgentSpec(name, name) for name in ("dqn", "ppo", "random", "sarsa"))
PLAIN_DQN = replace(DQN, tuned=False, settings={"policy": "MlpPolicy", "n_timesteps": 100})
MINE = AgentSpec("mine", "dqn", {"gamma": 0.9})
OWN_PLACE = replace(DQN, settings={"env_kwargs": {"is_slippery": False}})


def place(env_id, settings=None, **kwargs):
    settings = {"env_kwargs": kwargs} if kwargs else settings or {}
    return EnvironmentSpec("place", env_id, settings)


SLIPPERY, USUAL = place("Warehouse-v0", slip=0.1), place("Warehouse-v0", slip=0.0)
THESE = "were tuned on these"
NOT_KNOWN = "what the study's own settings of mine were tuned on is not known"
ELSEWHERE = "the settings of dqn were tuned with other arguments of the environment"


def tuned(agents, places=(TUNED_LAKE,), first=0, count=10):
    return tuning_seeds(study_of(*agents, environments=places, n_seeds=count, first_seed=first))


@pytest.mark.parametrize(
    ("agents", "places", "seeds", "sentence"),
    [
        ((DQN, PPO, RANDOM), [], (0, 10), f"the shipped settings of dqn and ppo {THESE}"),
        ((DQN, PPO, RANDOM), [], (1000, 10), "nothing was tuned on these"),
        ((DQN, PPO), [], (8, 10), "the shipped settings of dqn and ppo were tuned on 8 to 9 of"),
        ((PPO,), [], (3, 1), "the shipped settings of ppo were tuned on it"),
        ((PPO,), [], (33, 1), "nothing was tuned on it"),
        # The constructor's defaults were tuned on nothing, and a budget is no tuning.
        ((PLAIN_DQN,), [], (0, 10), "nothing was tuned on these"),
        (
            (replace(DQN, settings={"n_timesteps": 9}),),
            [],
            (0, 10),
            f"shipped settings of dqn {THESE}",
        ),
        ((MINE,), [], (0, 10), f"the shipped settings of dqn {THESE}; {NOT_KNOWN}"),
        ((MINE,), [], (1000, 10), f"nothing is known to have been tuned on these; {NOT_KNOWN}"),
        # Other arguments of the environment make it another.
        ((DQN,), [SLIPPERY], (0, 10), f": {ELSEWHERE}"),
        ((DQN,), [SLIPPERY], (1000, 10), f": {ELSEWHERE}"),
        ((RANDOM,), [SLIPPERY], (0, 10), "nothing was tuned on these"),
        ((DQN,), [SLIPPERY, TUNED_LAKE], (0, 10), f"settings of dqn {THESE}; {ELSEWHERE}"),
        ((OWN_PLACE,), [], (0, 10), f": {ELSEWHERE}"),
        ((DQN,), [USUAL], (0, 10), f"the shipped settings of dqn {THESE}"),
        ((DQN,), [place("RandomWarehouse-v0", size=10)], (0, 10), f"settings of dqn {THESE}"),
        ((DQN,), [place("Warehouse-v0", AS_IT_COMES)], (0, 10), f": {ELSEWHERE}"),
        # A table has no such changes in its settings; and one environment may have two names.
        ((TABLE,), [place("Warehouse-v0", AS_IT_COMES)], (0, 10), f"of sarsa {THESE}"),
        ((TABLE,), [place("CliffWalking-v1", is_slippery=True)], (0, 10), f"of sarsa {THESE}"),
    ],
)
def test_what_is_said_of_the_seeds(agents, places, seeds, sentence):
    first, count = seeds
    found = tuned(agents, [replace(p, label=p.env_id) for p in places] or [TUNED_LAKE], *seeds)
    said = seed_sentence(range(first, first + count), found)
    assert said.startswith(
        f"Seeds {first} to {first + count - 1}: " if count > 1 else f"Seed {first}: "
    )
    assert sentence in said
    assert said.endswith(".")


def test_settings_of_the_studys_own_are_not_known_of_and_each_environment_has_its_own():
    own = tuned([DQN, RANDOM], [replace(TUNED_LAKE, settings={"gamma": 0.9})])
    assert own.unknown == ("dqn", "random")
    sweep = [AgentSpec(f"g={g}", "dqn", {"gamma": g}, group="g") for g in (0.1, 0.2)]
    assert tuned(sweep).unknown == ("g",)
    both = tuned([PPO], [TUNED_LAKE, PENDULUM], count=101)
    assert both.shipped == {"ppo": frozenset([*range(10), 100])}
    # Many names are cut short.
    told = seed_sentence(range(10), TuningSeeds({}, {}, tuple("abcdefgh")))
    assert "of a, b, c, d, e, f and 2 more were" in told

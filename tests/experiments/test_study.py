"""Study files, each mistake in them, and from a study to its runs: folders, seeds, settings."""

import json
import re
from dataclasses import MISSING, fields, replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from rl_yardstick.pipeline.digests import DamagedFileError
from rl_yardstick.pipeline.runs import FAILED, FINISHED
from rl_yardstick.pipeline.train_spec import TrainSpec

import compare
from rl_yardstick.experiments.plan import check_settings, plan, tuning_seeds
from rl_yardstick.experiments.study import (
    AgentSpec,
    EnvironmentSpec,
    StudySpec,
    find_study,
    layered,
    read_study,
    write_study,
)
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.report.words import seed_sentence

SHIPPED = Path(compare.__file__).parent / "studies"


@pytest.fixture
def read(tmp_path):
    def read_text(text):
        path = tmp_path / "lakes.yml"
        path.write_text(text)
        return read_study(path)

    return read_text


BASE = "agents: [qlearning]\nenvironments: [FrozenLake-v1]\n"
TAXI = "environments: [Taxi-v4]\n"

# The text, the line that is named, and what is said of it.
MISTAKES = [
    ("", 1, "a study must map names to values"),
    (BASE + "title: [\n", 4, ""),
    (BASE + "seed: 3\n", 3, "unknown key 'seed': did you mean 'seeds'?"),
    (BASE + "seeds: 1\nseeds: 2\n", 4, "key 'seeds' appears twice"),
    (BASE + "\nseeds: many\n", 4, "seeds must be a whole number, not 'many'"),
    (BASE + "metric: finl\n", 3, "did you mean 'final'?"),
    (BASE + "run_timeout: -1\n", 3, "run_timeout must be a time"),
    (BASE + "quick:\n  budget: 0\n", 4, "above 0 and up to 1"),
    (BASE + "n_timesteps: 5\nn_episodes: 5\n", 4, "give n_timesteps or n_episodes, not both"),
    (BASE + "sweep:\n  gamma: []\n", 4, "gamma must be a list of values, not []"),
    ("agents: [dqn]\n", 1, "environments must list at least one name"),
    (TAXI + "agents: [sarsa, qlerning]\n", 2, "'qlerning': did you mean 'qlearning'?"),
    (TAXI + "agents:\n  dqn:\n    conf_file: no.yml\n", 4, "conf_file: there is no file "),
    ("agents: [dqn]\nenvironments: {ice: {id: FrozenLak-v1}}\n", 2, "mean 'FrozenLake-v1'"),
    ("agents: [dqn]\nenvironments: ['no_such:Taxi-v4']\n", 2, "add --gym-packages no_such"),
]


@pytest.mark.parametrize(("text", "line", "complaint"), MISTAKES)
def test_a_mistake_is_one_line_with_file_and_line(read, text, line, complaint):
    with pytest.raises(UserError) as error:
        read(text)
    message = str(error.value)
    assert "\n" not in message
    assert re.match(rf".*lakes\.yml:{line}:", message)
    assert complaint in message


KEYS = st.sampled_from(["agents", "environments", "sweep", "quick", "algo", "id", "seeds", "dqn"])


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=4),
        max_leaves=12,
    )
)
def test_whatever_stands_in_a_file_is_a_study_or_a_mistake(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "any.yml"
    path.write_text(yaml.safe_dump(data))
    try:
        study = read_study(path)
    except UserError as error:
        assert "any.yml" in str(error)  # noqa: PT017  # either is right
    else:
        assert study.agents
        assert study.environments


def test_agents_and_environments(read):
    study = read(
        "seeds: {first: 1000, count: 4}\nrun_memory: 1.5GB\n"
        "n_timesteps: 500\ntuned: false\nsettings: {gamma: 0.9, env_kwargs: {map_name: 4x4}}\n"
        "agents:\n"
        "  slow: {algo: qlearning, learning_rate: 0.01, summary: creeps}\n"
        "  sarsa: {tuned: true}\n"
        "environments:\n"
        "  small: {id: FrozenLake-v1}\n"
        "  dry: {id: FrozenLake-v1, n_episodes: 7, gamma: 0.8, env_kwargs: {is_slippery: false}}\n"
    )
    assert (study.seeds, study.run_memory) == (range(1000, 1004), 1_500_000_000)
    slow, sarsa = study.agents
    assert (slow.label, slow.algo, slow.tuned) == ("slow", "qlearning", False)
    assert (slow.summary, slow.settings) == ("creeps", {"learning_rate": 0.01})
    assert (sarsa.algo, sarsa.tuned) == ("sarsa", True)
    assert slow.where.endswith("lakes.yml:7")
    small, dry = study.environments
    usual = {"n_timesteps": 500, "gamma": 0.9, "env_kwargs": {"map_name": "4x4"}}
    assert (small.env_id, small.settings) == ("FrozenLake-v1", usual)
    # One budget replaces the other, and arguments of the environment are put over one by one.
    arguments = {"map_name": "4x4", "is_slippery": False}
    assert dry.settings == {"n_episodes": 7, "gamma": 0.8, "env_kwargs": arguments}
    quick = study.quickened()
    assert (quick.name, quick.is_quick) == ("lakes-quick", True)
    assert quick.n_seeds < study.n_seeds


def test_an_agent_has_a_file_of_settings_beside_the_study(read, tmp_path):
    (tmp_path / "mine.yml").write_text("FrozenLake-v1: {n_timesteps: 7, gamma: 0.5}\n")
    study = read(
        "seeds: 1\nenvironments: [FrozenLake-v1]\ntuned: false\nagents:\n  sarsa: {n_timesteps: 9}"
        "\n  mine: {algo: sarsa, conf_file: mine.yml, learning_rate: 0.25}\n"
    )
    assert [run.spec.saved_hyperparams for run in plan(study, tmp_path)] == [
        {"n_timesteps": 9},
        {"n_timesteps": 7, "gamma": 0.5, "learning_rate": 0.25},
    ]


# --- Sweeps.


def test_sweeps_multiply_and_are_counted_before_they_are_made(read):
    study = read(
        TAXI + "sweep: {gamma: [0.9, 0.99], learning_rate: [0.1, 0.5]}\n"
        "agents:\n  qlearning:\n  sarsa:\n    sweep: {gamma: [0.5]}\n"
    )
    assert [agent.label for agent in study.agents] == [
        *(f"qlearning with γ = {g} with α = {a}" for g in (0.9, 0.99) for a in (0.1, 0.5)),
        *(f"sarsa with γ = 0.5 with α = {a}" for a in (0.1, 0.5)),
    ]
    assert study.agents[2].settings == {"gamma": 0.99, "learning_rate": 0.1}
    sweep = ", ".join(f"{name}: {list(range(100))}" for name in "abcdef")
    with pytest.raises(UserError, match=r":4: 1,000,000,000,001 agents up to here; .* 10,000 at"):
        read(f"{TAXI}agents:\n  sarsa:\n  qlearning:\n    sweep: {{{sweep}}}\n")


# --- Names and files.


def test_a_shipped_study_is_found_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = SHIPPED / "mine-maze.yml"
    for name in ("mine-maze", "studies/mine-maze.yml"):
        assert find_study(name).samefile(shipped)
    assert read_study(shipped).name == "mine-maze"
    # A file of the user's own comes first, and elsewhere ours are not looked for.
    Path("mine-maze.yml").touch()
    assert find_study("mine-maze.yml") == Path("mine-maze.yml")
    assert find_study("mine-maze").samefile(shipped)
    with pytest.raises(UserError, match=r"mine-mase: cannot be read: .* did you mean 'mine-maze'"):
        find_study("mine-mase")


def test_what_is_written_asks_for_the_same(tmp_path):
    paths = [path for path in sorted(SHIPPED.rglob("*.yml")) if path.parent.name != "search"]
    assert len(paths) > 10
    for number, path in enumerate(paths):
        study, place = read_study(path), tmp_path / str(number)
        place.mkdir()
        write_study(place, study)
        again = read_study(place / "study.yml")
        assert replace(again, name=study.name, source=path) == study, path


def test_what_flags_changed_is_written(read, tmp_path):
    """Also where it leaves of a sweep nothing that a file could say as one."""
    (tmp_path / "map.txt").write_text("S.\n.G\n")
    (tmp_path / "mine.yml").write_text("default:\n  n_timesteps: 9\n")
    text = "agents: {qlearning: {sweep: {gamma: [0.5, 0.9]}}, sarsa: {conf_file: mine.yml}}\n"
    study = read(f"{text}environments: [Warehouse-v0]\nrun_timeout: 10m\n")
    arguments = {"desc": str(tmp_path / "map.txt"), "slip": 0.1}
    changed = [layered(a.settings, {"gamma": 0.7, "env_kwargs": arguments}) for a in study.agents]
    agents = [replace(a, settings=s) for a, s in zip(study.agents, changed, strict=True)]
    (tmp_path / "there").mkdir()
    write_study(tmp_path / "there", replace(study, agents=tuple(agents), n_seeds=3))
    again = read_study(tmp_path / "there" / "study.yml")
    assert (again.n_seeds, again.run_timeout) == (3, 600)
    assert [agent.label for agent in again.agents] == [agent.label for agent in study.agents]
    wanted = [{**s, "env_kwargs": {"desc": ["S.", ".G"], "slip": 0.1}} for s in changed]
    assert [agent.settings for agent in again.agents] == wanted
    assert again.agents[2].conf_file.read_text() == "default:\n  n_timesteps: 9\n"
    assert again.agents[2].conf_file.parent == tmp_path / "there" / "settings"
    write_study(tmp_path, study.quickened())
    assert not (tmp_path / "study.yml").exists()


# === from a study to its runs =====================================================================


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


def test_a_study_has_a_bearable_number_of_runs():
    study = study_of("qlearning", "sarsa", "dqn", environments=(LAKE, DRY), n_seeds=10**12)
    told = (
        "^lakes: 3 agents on 2 environments with 1,000,000,000,000 seeds are "
        "6,000,000,000,000 runs; a study has .* at most$"
    )
    with pytest.raises(UserError, match=told):
        plan(study, NOWHERE)


def test_labels_that_would_share_a_folder():
    for labels in (("a b", "a/b"), ("Mine", "mine"), ("same", "same")):
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


UNTRAINABLE = [
    ("qlearning", {"n_timesteps": None}, "how long to train"),
    ("linucb", {}, "does not fit FrozenLake-v1"),
    ("qlearning", {"env_kwargs": {"slipery": True}}, "slipery"),
    # What the agent itself refuses is found with the libraries.
    ("qlearning", {"learning_rat": 0.1}, r"did you mean 'learning_rate'\?"),
    ("qlearning", {"gamma": 1.5}, "gamma"),
]


@pytest.mark.parametrize(("algo", "settings", "complaint"), UNTRAINABLE)
def test_what_cannot_be_trained_is_refused_beforehand(tmp_path, algo, settings, complaint):
    agents = AgentSpec("good", "sarsa"), AgentSpec("bad", algo, settings, where="lakes.yml:7")
    study = study_of(*agents, n_seeds=2)
    with pytest.raises(UserError, match=rf"^lakes\.yml:7: .*{complaint}"):
        check_settings(study, plan(study, tmp_path))
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
    assert only(replace(PLAIN, tensorboard=True), tmp_path).is_finished
    # What is shown meanwhile is no part of it.
    loud = replace(planned.spec, verbose=2, progress=True, log_interval=7, pictures=True)
    record(replace(planned, spec=loud))
    assert planned.is_finished
    planned.run.info_path.write_text("{")
    assert not planned.is_finished
    assert not planned.is_to_do
    with pytest.raises(DamagedFileError, match=r"run\.json is damaged"):
        planned.check_record()


OTHERS = {
    "setting": study_of(AgentSpec("qlearning", "qlearning", {"gamma": 0.123})),
    "budget": study_of("qlearning", environments=(replace(LAKE, settings={"n_timesteps": 101}),)),
    "environment": study_of("qlearning", environments=(replace(LAKE, env_id="FrozenLake8x8-v1"),)),
    "eval_freq": study_of("qlearning", eval_freq=50),
}


def test_a_run_of_other_settings_does_not_count(tmp_path):
    record(only(PLAIN, tmp_path))
    assert only(PLAIN, tmp_path).is_finished
    assert [name for name, study in OTHERS.items() if only(study, tmp_path).is_finished] == []


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

DQN, PPO, RANDOM = (AgentSpec(name, name) for name in ("dqn", "ppo", "random"))

PLAIN_DQN = replace(DQN, tuned=False, settings={"policy": "MlpPolicy", "n_timesteps": 100})
MINE = AgentSpec("mine", "dqn", {"gamma": 0.9})


def place(env_id, **kwargs):
    return EnvironmentSpec(env_id, env_id, {"env_kwargs": kwargs} if kwargs else {})


TUNED, SLIPPERY, USUAL = place("FrozenLake-v1"), place("Warehouse-v0", slip=0.1), "Warehouse-v0"
THESE, NOTHING = "were tuned on these", "nothing was tuned on these"
NOT_KNOWN = "what the study's own settings of mine were tuned on is not known"
ELSEWHERE = "the settings of dqn were tuned with other arguments of the environment"
# Agents, environments, the first seed and how many there are, and what is said of them.
SEEDS = [
    ((DQN, PPO, RANDOM), [TUNED], (0, 10), f"the shipped settings of dqn and ppo {THESE}"),
    ((DQN, PPO), [TUNED], (8, 10), "settings of dqn and ppo were tuned on 8 to 9 of"),
    # The constructor's defaults were tuned on nothing.
    ((PLAIN_DQN,), [TUNED], (0, 10), NOTHING),
    ((MINE,), [TUNED], (0, 10), f"the shipped settings of dqn {THESE}; {NOT_KNOWN}"),
    ((MINE,), [TUNED], (1000, 10), f"nothing is known to have been tuned on these; {NOT_KNOWN}"),
    # Other arguments of the environment make it another.
    ((DQN,), [SLIPPERY], (1000, 10), f": {ELSEWHERE}"),
    ((DQN,), [place(USUAL, slip=0.0)], (0, 10), f"the shipped settings of dqn {THESE}"),
]


def tuned(agents, places=(TUNED,), first=0, count=10):
    return tuning_seeds(study_of(*agents, environments=places, n_seeds=count, first_seed=first))


@pytest.mark.parametrize(("agents", "places", "seeds", "sentence"), SEEDS)
def test_what_is_said_of_the_seeds(agents, places, seeds, sentence):
    first, count = seeds
    said = seed_sentence(range(first, first + count), tuned(agents, places, *seeds))
    assert said.startswith(f"Seeds {first} to {first + count - 1}: ")
    assert sentence in said
    assert said.endswith(".")

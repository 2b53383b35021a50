"""Study files, each mistake in them, and from a study to its runs: folders, seeds, settings."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from rl_yardstick.experiments import plan as plans
from rl_yardstick.experiments import study as studies
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, read_study
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.run import FAILED, FINISHED
from rl_yardstick.pipeline.settings import read_yaml
from rl_yardstick.report.words import seed_sentence

SHIPPED = Path(studies.__file__).parents[1] / "studies"
MISTAKES = read_yaml(Path(__file__).with_name("wrong_studies.yml"))


@pytest.fixture
def read(tmp_path):
    def read_text(text):
        path = tmp_path / "lakes.yml"
        path.write_text(text)
        return read_study(path)

    return read_text


@pytest.mark.parametrize(("text", "complaint"), MISTAKES)
def test_a_mistake_is_one_line_with_the_file(read, text, complaint):
    with pytest.raises(UserError) as error:
        read(text)
    message = str(error.value)
    assert re.match(r".*lakes\.yml: ", message)
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
        "seeds: {first: 1000, count: 4}\nrun_timeout: 10m\neval_freq: 1e4\n"
        "n_timesteps: 500\ntuned: false\nsettings: {gamma: 0.9, env_kwargs: {map_name: 4x4}}\n"
        "agents:\n"
        "  slow: {algo: qlearning, learning_rate: 0.01, summary: creeps}\n"
        "  sarsa: {tuned: true}\n"
        "environments:\n"
        "  small: {id: FrozenLake-v1}\n"
        "  dry: {id: FrozenLake-v1, n_episodes: 7, gamma: 0.8, env_kwargs: {is_slippery: false}}\n"
    )
    assert (study.seeds, study.run_timeout) == (range(1000, 1004), 600)
    assert study.eval_freq == 10_000
    slow, sarsa = study.agents
    assert (slow.label, slow.algo, slow.tuned) == ("slow", "qlearning", False)
    assert (slow.summary, slow.settings) == ("creeps", {"learning_rate": 0.01})
    assert (sarsa.algo, sarsa.tuned) == ("sarsa", True)
    assert slow.where.endswith("lakes.yml")
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
    assert [run.spec.hyperparams for run in plans.plan(study, tmp_path)] == [
        {"n_timesteps": 9},
        {"n_timesteps": 7, "gamma": 0.5, "learning_rate": 0.25},
    ]


def test_sweeps_multiply(read):
    study = read(
        "environments: [Taxi-v4]\nsweep: {gamma: [0.9, 0.99], learning_rate: [0.1, 0.5]}\n"
        "agents:\n  qlearning:\n  sarsa:\n    sweep: {gamma: [0.5]}\n"
    )
    assert [agent.label for agent in study.agents] == [
        *(f"qlearning with γ = {g} with α = {a}" for g in (0.9, 0.99) for a in (0.1, 0.5)),
        *(f"sarsa with γ = 0.5 with α = {a}" for a in (0.1, 0.5)),
    ]
    assert study.agents[2].settings == {"gamma": 0.99, "learning_rate": 0.1}


def test_a_shipped_study_is_found_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = SHIPPED / "mine-maze.yml"
    for name in ("mine-maze", "studies/mine-maze.yml"):
        assert studies.find_study(name) == shipped
    assert read_study(shipped).name == "mine-maze"
    # A file of the user's own comes first, and elsewhere ours are not looked for.
    Path("mine-maze.yml").touch()
    assert studies.find_study("mine-maze.yml") == Path("mine-maze.yml")
    assert studies.find_study("mine-maze") == shipped
    with pytest.raises(UserError, match=r"mine-mase: no such file.* did you mean 'mine-maze'"):
        studies.find_study("mine-mase")


@pytest.mark.parametrize("path", sorted(SHIPPED.rglob("*.yml")), ids=lambda path: path.stem)
def test_a_shipped_study_is_read_back_from_its_record(path, tmp_path):
    """With the rows of its maps: `--resume` needs no other file."""
    if path.parent.name == "search":
        return
    study = read_study(path)
    study = replace(study, agents=study.agents[:3], environments=study.environments[:2])
    record = plans.StudyRecord(study, plans.specs_of(study), looks=(5, 10))
    record.write(tmp_path)
    assert plans.StudyRecord.read(tmp_path) == record


@pytest.mark.parametrize("content", ["", "{}", '{"study": 3, "looks": [], "specs": []}'])
def test_a_record_that_is_none(content, tmp_path):
    (tmp_path / "study.json").write_text(content)
    with pytest.raises(UserError, match=r"study\.json"):
        plans.StudyRecord.read(tmp_path)


NOWHERE = Path("nowhere")
LAKE = EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1", {"n_timesteps": 100})
DRY = EnvironmentSpec("dry lake", "FrozenLake-v1", {"n_episodes": 9})


def study_of(*agents, environments=(LAKE,), **fields):
    agents = tuple(AgentSpec(agent, agent) if isinstance(agent, str) else agent for agent in agents)
    return studies.StudySpec("lakes", "Lakes", agents, tuple(environments), **fields)


def only(study, root=NOWHERE):
    (planned,) = plans.plan(replace(study, n_seeds=1), root)
    return planned


def test_every_agent_on_every_environment_with_every_seed(tmp_path):
    study = study_of("qlearning", "sarsa", environments=(LAKE, DRY), n_seeds=3)
    planned = plans.plan(study, tmp_path)
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
    assert list(tmp_path.iterdir()) == []


def test_the_agents_settings_go_over_the_environments_and_those_over_the_file():
    usual = {"gamma": 0.5, "learning_rate": 0.5, "env_kwargs": {"is_slippery": False}}
    own = {"learning_rate": 0.25, "n_episodes": 7, "env_kwargs": {"map_name": "8x8"}}
    environment = EnvironmentSpec("lake", "FrozenLake-v1", usual)
    study = study_of(AgentSpec("mine", "qlearning", own), environments=(environment,))
    spec = only(study).spec
    assert spec.algorithm["gamma"] == 0.5
    assert spec.algorithm["learning_rate"] == 0.25
    assert spec.env_kwargs == {"is_slippery": False, "map_name": "8x8"}
    assert (spec.n_episodes, spec.n_timesteps) == (7, None)
    # What neither of them mentions comes from the file.
    file = only(study_of("qlearning")).spec.algorithm
    untouched = set(file) - {"gamma", "learning_rate"}
    assert untouched
    assert all(spec.algorithm[key] == file[key] for key in untouched)


UNTRAINABLE = [
    ("qlearning", {"n_timesteps": None}, "no budget"),
    ("qlearning", {"n_timesteps": 5, "n_episodes": 5}, "give n_timesteps or n_episodes, not both"),
    ("linucb", {}, "does not fit FrozenLake-v1"),
    ("qlearning", {"learning_rat": 0.1}, r"did you mean 'learning_rate'\?"),
]


@pytest.mark.parametrize(("algo", "settings", "complaint"), UNTRAINABLE)
def test_what_cannot_be_trained_is_refused_beforehand(tmp_path, algo, settings, complaint):
    agents = AgentSpec("good", "sarsa"), AgentSpec("bad", algo, settings, where="lakes.yml")
    with pytest.raises(UserError, match=rf"^lakes\.yml: bad on FrozenLake-v1: .*{complaint}"):
        plans.plan(study_of(*agents, n_seeds=2), tmp_path)
    assert list(tmp_path.iterdir()) == []


def record(planned, state=FINISHED, **fields):
    """What a run that has come to its end leaves."""
    planned.path.mkdir(parents=True, exist_ok=True)
    planned.run.record(planned.spec, state, **fields)


PLAIN = study_of("qlearning")


def test_a_run_is_finished_where_its_folder_says_so(tmp_path):
    planned = only(PLAIN, tmp_path)
    assert not planned.is_finished
    record(planned, FAILED)
    assert not planned.is_finished
    record(planned)
    assert planned.is_finished
    assert only(replace(PLAIN, tensorboard=True), tmp_path).is_finished
    # What is written meanwhile is no part of it.
    otherwise = {"log_interval": 7, "pictures": True, "origins": {"gamma": "auto"}}
    assert otherwise.keys() <= set(plans.MAY_DIFFER)
    record(replace(planned, spec=planned.spec.changed(**otherwise)))
    assert planned.is_finished
    (planned.path / "run.json").write_text("{")
    assert not planned.is_finished


OTHERS = (
    study_of(AgentSpec("qlearning", "qlearning", {"gamma": 0.123})),
    study_of("qlearning", environments=(replace(LAKE, settings={"n_timesteps": 101}),)),
    study_of("qlearning", environments=(replace(LAKE, env_id="FrozenLake8x8-v1"),)),
    study_of("qlearning", eval_freq=50),
)


def test_a_run_of_other_settings_does_not_count(tmp_path):
    record(only(PLAIN, tmp_path))
    plans.check_settings_kept(tmp_path, [only(PLAIN, tmp_path)])
    assert not any(only(study, tmp_path).is_finished for study in OTHERS)
    with pytest.raises(UserError, match=r"1 finished run has .*gamma: [\d.]+ there, 0.123 now"):
        plans.check_settings_kept(tmp_path, [only(OTHERS[0], tmp_path)])


DQN, PPO, RANDOM = (AgentSpec(name, name) for name in ("dqn", "ppo", "random"))

PLAIN_DQN = replace(DQN, tuned=False, settings={"policy": "MlpPolicy", "n_timesteps": 100})
MINE = AgentSpec("mine", "dqn", {"gamma": 0.9})


def place(env_id, **kwargs):
    return EnvironmentSpec(env_id, env_id, {"env_kwargs": kwargs} if kwargs else {})


TUNED, SLIPPERY, USUAL = place("FrozenLake-v1"), place("Warehouse-v0", slip=0.1), "Warehouse-v0"
THESE, NOTHING = "were tuned on these", "nothing was tuned on these"
NOT_KNOWN = "the study's own settings of mine may have been tuned on these"
ELSEWHERE = "the settings of dqn were tuned with other arguments of the environment"
# Agents, environments, the first seed and how many there are, and what is said of them.
SEEDS = [
    ((DQN, PPO, RANDOM), [TUNED], (0, 10), f"the shipped settings of dqn and ppo {THESE}"),
    ((DQN, PPO), [TUNED], (8, 10), "settings of dqn and ppo were tuned on 8 to 9 of"),
    # The constructor's defaults were tuned on nothing.
    ((PLAIN_DQN,), [TUNED], (0, 10), NOTHING),
    ((MINE,), [TUNED], (0, 10), f"the shipped settings of dqn {THESE}; {NOT_KNOWN}"),
    ((MINE,), [TUNED], (1000, 10), f"Seeds 1000 to 1009: {NOT_KNOWN}"),
    # Other arguments of the environment make it another.
    ((DQN,), [SLIPPERY], (1000, 10), f": {ELSEWHERE}"),
    ((DQN,), [place(USUAL, slip=0.0)], (0, 10), f"the shipped settings of dqn {THESE}"),
]


@pytest.mark.parametrize(("agents", "places", "seeds", "sentence"), SEEDS)
def test_what_is_said_of_the_seeds(agents, places, seeds, sentence):
    first, count = seeds
    study = study_of(*agents, environments=places, n_seeds=count, first_seed=first)
    said = seed_sentence(study.seeds, plans.tuning_seeds(study))
    assert said.startswith(f"Seeds {first} to {first + count - 1}: ")
    assert sentence in said
    assert said.endswith(".")

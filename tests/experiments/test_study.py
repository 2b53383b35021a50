"""Study files: what they may say, and how each mistake is told."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import compare
from experiments.plan import plan
from experiments.study import (
    METRICS,
    QuickSpec,
    file_name,
    find_study,
    layered,
    read_study,
    write_study,
)
from pipeline.environments import training_changes
from pipeline.errors import UserError
from pipeline.files import portable_name

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
    (BASE + "seeds: 0\n", 3, "seeds must be at least 1, not 0"),
    (BASE + "seeds: {first: -1}\n", 3, "first must be at least 0, not -1"),
    (BASE + "seeds: {last: 3}\n", 3, "unknown key 'last'"),
    (BASE + "seeds: [1, 2]\n", 3, "seeds"),
    (BASE + "metric: finl\n", 3, "did you mean 'final'?"),
    (BASE + "margin: -0.1\n", 3, "margin must be at least 0, not -0.1"),
    (BASE + "run_timeout: -1\n", 3, "run_timeout must be a time"),
    (BASE + "run_memory: 4\n", 3, "run_memory must be a size"),
    (BASE + "settings: 3\n", 3, "settings must map names to values"),
    (BASE + "quick: {seed: 1}\n", 3, "unknown key 'seed'"),
    (BASE + "quick:\n  budget: 0\n", 4, "above 0 and up to 1"),
    (BASE + "n_timesteps: 5\nn_episodes: 5\n", 4, "give n_timesteps or n_episodes, not both"),
    (TAXI + "agents:\n  sarsa:\n    n_timesteps: 5\n    n_episodes: 5\n", 5, "not both"),
    (BASE + "sweep:\n  gamma: []\n", 4, "gamma must be a list of values, not []"),
    (BASE + "sweep: [0.9]\n", 3, "sweep must map names to values"),
    (TAXI + "agents: [dqn, dqn]\n", 2, "agents names one of them twice"),
    (TAXI + "agents:\n", 2, "at least one name"),
    ("agents: [dqn]\n", 1, "environments must list at least one name"),
    (TAXI + "agents:\n  - algo: dqn\n", 2, "agents must list names, or map them to settings"),
    (TAXI + "agents:\n  dqn: 3\n", 3, "dqn must map names to values"),
    (TAXI + "agents:\n  mine:\n    algo: [dqn]\n", 4, "unknown agent"),
    (TAXI + "agents: [sarsa, qlerning]\n", 2, "'qlerning': did you mean 'qlearning'?"),
    (TAXI + "agents:\n  mine:\n    gamma: 0.9\n    algo: saarsa\n", 5, "did you mean 'sarsa'?"),
    (TAXI + "agents:\n  dqn:\n    conf_file: no.yml\n", 4, "conf_file: there is no file "),
    (TAXI + "agents:\n  dqn: {conf_file: [a]}\n", 3, "conf_file must be a text"),
    (TAXI + "agents: {dqn: {conf_file: lakes.yml, tuned: false}}\n", 2, "contradict each other"),
    ("agents: [dqn]\nenvironments:\n  lake: {id: 3}\n", 3, "id must be a text"),
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


ONE_LINE = [
    ("", "n_seeds", 10),
    ("", "title", "lakes"),
    ("", "run_timeout", None),
    ("seeds: 3", "seeds", range(3)),
    ("seeds: {first: 1000, count: 4}", "seeds", range(1000, 1004)),
    ("seeds: {first: 7}", "seeds", range(7, 17)),
    ("run_timeout: 10m", "run_timeout", 600),
    ("run_timeout: 90", "run_timeout", 90),
    ("run_memory: 1.5GB", "run_memory", 1_500_000_000),
    ("quick: {seeds: 1, budget: 0.5}", "quick", QuickSpec(1, 0.5)),
    ("description: Two lakes.", "description", "Two lakes."),
    *((f"{name}: 20", name, 20) for name in ("eval_freq", "eval_episodes", "episodes_table")),
    *((f"{name}: 0.5", name, 0.5) for name in ("margin", "threshold")),
    *((f"metric: {metric}", "metric", metric) for metric in METRICS),
]


def test_what_one_line_says(read):
    for line, name, value in ONE_LINE:
        assert getattr(read(f"{BASE}{line}\n"), name) == value


def test_agents_and_environments(read):
    study = read(
        "n_timesteps: 500\ntuned: false\nsettings: {gamma: 0.9, env_kwargs: {map_name: 4x4}}\n"
        "agents:\n"
        "  slow: {algo: qlearning, learning_rate: 0.01, summary: creeps}\n"
        "  sarsa: {tuned: true}\n"
        "environments:\n"
        "  small: {id: FrozenLake-v1}\n"
        "  dry: {id: FrozenLake-v1, n_episodes: 7, gamma: 0.8, env_kwargs: {is_slippery: false}}\n"
    )
    slow, sarsa = study.agents
    assert (slow.label, slow.algo, slow.tuned) == ("slow", "qlearning", False)
    assert (slow.summary, slow.settings) == ("creeps", {"learning_rate": 0.01})
    assert (sarsa.algo, sarsa.tuned) == ("sarsa", True)
    assert slow.where.endswith("lakes.yml:5")
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


def test_an_environment_as_it_comes_is_trained_on_as_it_is_judged_on(read, tmp_path):
    study = read(
        "seeds: 1\nagents: {ppo: {}, own: {algo: ppo, train_env_kwargs: {slip: 0.1}}}\n"
        "environments:\n"
        "  usual: {id: Warehouse-v0}\n"
        "  as it comes: {id: Warehouse-v0, as_it_comes: true, env_kwargs: {slip: 0.2}}\n"
    )
    starts = ("random starts", "episodes of 100 steps")
    rewards = ("rewards clipped at -10", "rewards x 0.01")
    found = {(p.agent, p.environment): training_changes(p.spec) for p in plan(study, tmp_path)}
    assert found == {
        ("ppo", "usual"): (*starts, *rewards),
        ("ppo", "as it comes"): (),
        ("own", "usual"): (*starts, "slip 0.1", *rewards),
        ("own", "as it comes"): ("slip 0.1",),  # an agent's own entry goes over all others
    }


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


@given(st.text() | st.text(min_size=99, max_size=300) | st.sampled_from(["CON", "nul.x", "a."]))
def test_a_label_makes_a_plain_file_name(label):
    name = file_name(label)
    assert name == file_name(name) == portable_name(name)
    assert re.fullmatch(r"[\w.=+,-]+", name)
    assert name not in (".", "..")


def test_a_shipped_study_is_found_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = SHIPPED / "mine-maze.yml"
    for name in ("mine-maze", "mine-maze.yml", "studies/mine-maze.yml", "./mine-maze.yml"):
        assert find_study(name) == shipped
    assert read_study(shipped).name == "mine-maze"
    # A file of the user's own comes first, and elsewhere ours are not looked for.
    Path("mine-maze.yml").touch()
    assert find_study("mine-maze.yml") == Path("mine-maze.yml")
    assert find_study("mine-maze") == shipped
    assert find_study("other/mine-maze.yml") == Path("other/mine-maze.yml")
    with pytest.raises(UserError, match=r"mine-mase: cannot be read: .* did you mean 'mine-maze'"):
        find_study("mine-mase")


@pytest.mark.parametrize(
    "path",
    [path for path in sorted(SHIPPED.rglob("*.yml")) if path.parent.name != "search"],
    ids=lambda path: path.stem,
)
def test_what_is_written_asks_for_the_same(path, tmp_path):
    study = read_study(path)
    write_study(tmp_path, study)
    again = read_study(tmp_path / "study.yml")
    assert replace(again, name=study.name, source=path) == study


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

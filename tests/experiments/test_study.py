"""Study files: what they may say, and how each mistake is told."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from agents import ALGORITHMS
from experiments import study
from experiments.plan import plan
from experiments.study import (
    METRICS,
    AgentSpec,
    QuickSpec,
    file_name,
    find_study,
    layered,
    read_study,
    swept,
    write_study,
)
from pipeline.environments import training_changes
from pipeline.errors import UserError
from pipeline.files import portable_name


@pytest.fixture
def read(tmp_path):
    def read_text(text):
        path = tmp_path / "lakes.yml"
        path.write_text(text)
        return read_study(path)

    return read_text


BASE = "agents: [qlearning]\nenvironments: [FrozenLake-v1]\n"

MISTAKES = {
    "unknown key": (BASE + "seed: 3\n", 3, "unknown key 'seed': did you mean 'seeds'?"),
    "unknown agent": (
        "agents: [sarsa, qlerning]\nenvironments: [FrozenLake-v1]\n",
        1,
        "unknown agent 'qlerning': did you mean 'qlearning'?",
    ),
    "unknown agent in a mapping": (
        "environments: [FrozenLake-v1]\nagents:\n  mine:\n    gamma: 0.9\n    algo: saarsa\n",
        5,
        "unknown agent 'saarsa': did you mean 'sarsa'?",
    ),
    "agent that is a list": (
        "environments: [FrozenLake-v1]\nagents:\n  mine:\n    algo: [dqn]\n",
        4,
        "unknown agent",
    ),
    "unknown environment": (
        "agents: [sarsa]\nenvironments:\n  lake: {id: FrozenLake-v1}\n  ice: {id: FrozenLak-v1}\n",
        4,
        "unknown environment 'FrozenLak-v1': did you mean 'FrozenLake-v1'",
    ),
    "no number": (BASE + "\nseeds: many\n", 4, "seeds must be a whole number, not 'many'"),
    "no seeds": (BASE + "seeds: 0\n", 3, "seeds must be at least 1, not 0"),
    "metric": (BASE + "metric: finl\n", 3, "did you mean 'final'?"),
    "negative margin": (BASE + "margin: -0.1\n", 3, "margin must be at least 0, not -0.1"),
    "two budgets": (
        BASE + "n_timesteps: 5\nn_episodes: 5\n",
        4,
        "give n_timesteps or n_episodes, not both",
    ),
    "two budgets of an agent": (
        "agents:\n  sarsa:\n    n_timesteps: 5\n    n_episodes: 5\nenvironments: [Taxi-v4]\n",
        4,
        "not both",
    ),
    "agent twice": (
        "environments: [Taxi-v4]\nagents: [dqn, dqn]\n",
        2,
        "agents names one of them twice",
    ),
    "key twice": (BASE + "seeds: 1\nseeds: 2\n", 4, "key 'seeds' appears twice"),
    "no agents": ("agents: []\nenvironments: [Taxi-v4]\n", 1, "at least one name"),
    "agents left empty": ("agents:\nenvironments: [Taxi-v4]\n", 1, "at least one name"),
    "no environments": ("agents: [dqn]\n", 1, "environments must list at least one name"),
    "no file of settings": (
        "environments: [Taxi-v4]\nagents:\n  dqn:\n    conf_file: no.yml\n",
        4,
        "conf_file: there is no file ",
    ),
    "settings and none": (
        "environments: [Taxi-v4]\nagents:\n  dqn:\n    conf_file: lakes.yml\n    tuned: false\n",
        4,
        "and tuned: false contradict each other",
    ),
    "file of settings that is none": (
        "environments: [Taxi-v4]\nagents:\n  dqn: {conf_file: [a]}\n",
        3,
        "conf_file must be a text",
    ),
    "module of an id": (
        "agents: [dqn]\nenvironments: ['no_such_module:Taxi-v4']\n",
        2,
        "not imported because a file asks: add --gym-packages no_such_module",
    ),
    "list of mappings": (
        "agents:\n  - algo: dqn\nenvironments: [Taxi-v4]\n",
        1,
        "agents must list names, or map them to settings",
    ),
    "agent that is a number": (
        "environments: [Taxi-v4]\nagents:\n  dqn: 3\n",
        3,
        "dqn must map names to values",
    ),
    "empty sweep": (BASE + "sweep:\n  gamma: []\n", 4, "gamma must be a list of values, not []"),
    "sweep of one": (BASE + "sweep:\n  gamma: 0.9\n", 4, "must be a list of values, not 0.9"),
    "sweep that is a list": (BASE + "sweep: [0.9]\n", 3, "sweep must map names to values"),
    "quick": (BASE + "quick: {seed: 1}\n", 3, "unknown key 'seed'"),
    "quick budget": (BASE + "quick:\n  budget: 0\n", 4, "above 0 and up to 1"),
    "environment id": ("agents: [dqn]\nenvironments:\n  lake: {id: 3}\n", 3, "id must be a text"),
    "settings": (BASE + "settings: 3\n", 3, "settings must map names to values"),
    "no mapping": ("- qlearning\n", 1, "a study must map names to values"),
    "no YAML": (BASE + "title: [\n", 4, ""),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_with_file_and_line(read, mistake):
    text, line, complaint = MISTAKES[mistake]
    with pytest.raises(UserError) as error:
        read(text)
    message = str(error.value)
    assert "\n" not in message
    assert re.match(rf".*lakes\.yml:{line}:", message)
    assert complaint in message


def test_an_empty_or_missing_file(read, tmp_path):
    with pytest.raises(UserError, match=r"lakes\.yml:1: a study must map names to values"):
        read("")
    with pytest.raises(UserError, match=r"nowhere\.yml: cannot be read"):
        read_study(tmp_path / "nowhere.yml")


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(
                    ["agents", "environments", "sweep", "quick", "algo", "id", "seeds", "dqn"]
                ),
                inner,
                max_size=4,
            )
        ),
        max_leaves=12,
    )
)
def test_whatever_stands_in_a_file_is_a_study_or_a_mistake(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "any.yml"
    path.write_text(yaml.safe_dump(data))
    try:
        study = read_study(path)
    except UserError as error:
        mistake = str(error)
    else:
        mistake = None
        assert study.agents
        assert study.environments
    assert mistake is None or "any.yml" in mistake


def test_a_list_is_short_for_a_mapping(read):
    short = read("agents: [qlearning, sarsa]\nenvironments: [Taxi-v4]\n")
    long = read(
        "agents: {qlearning: , sarsa: {algo: sarsa}}\nenvironments: {Taxi-v4: {id: Taxi-v4}}\n"
    )
    assert (short.agents, short.environments) == (long.agents, long.environments)
    assert short.name == short.title == "lakes"
    assert short.n_seeds == 10


def test_what_a_study_says(read):
    study = read(
        "title: Which?\ndescription: Two lakes.\nseeds: 3\nn_episodes: 50\ntuned: false\n"
        "eval_freq: 20\neval_episodes: 4\nmetric: area\nmargin: 0.5\nthreshold: 0.7\n"
        "episodes_table: 10\nquick: {seeds: 1, budget: 0.5}\n"
        "agents:\n"
        "  slow: {algo: qlearning, learning_rate: 0.01, summary: creeps}\n"
        "  sarsa: {tuned: true}\n"
        "environments:\n"
        "  slippery: {id: FrozenLake-v1}\n"
        "  dry: {id: FrozenLake-v1, env_kwargs: {is_slippery: false}}\n"
    )
    assert (study.title, study.description, study.n_seeds) == ("Which?", "Two lakes.", 3)
    assert (study.eval_freq, study.eval_episodes, study.metric) == (20, 4, "area")
    assert (study.margin, study.threshold, study.episodes_table) == (0.5, 0.7, 10)
    assert study.quick == QuickSpec(1, 0.5)
    slow, sarsa = study.agents
    assert (slow.label, slow.algo, slow.tuned, slow.summary) == (
        "slow",
        "qlearning",
        False,
        "creeps",
    )
    assert slow.settings == {"learning_rate": 0.01}
    assert (sarsa.algo, sarsa.tuned) == ("sarsa", True)
    assert slow.where.endswith("lakes.yml:14")
    slippery, dry = study.environments
    assert (slippery.env_id, slippery.settings) == ("FrozenLake-v1", {"n_episodes": 50})
    assert dry.settings == {"n_episodes": 50, "env_kwargs": {"is_slippery": False}}


def test_settings_of_an_environment_go_over_those_of_the_file(read):
    study = read(
        "agents: [qlearning]\nn_timesteps: 500\n"
        "settings: {gamma: 0.9, env_kwargs: {is_slippery: false, map_name: 4x4}}\n"
        "environments:\n"
        "  small: {id: FrozenLake-v1}\n"
        "  large: {id: FrozenLake-v1, n_episodes: 7, gamma: 0.8, env_kwargs: {map_name: 8x8}}\n"
    )
    small, large = study.environments
    assert small.settings == {
        "n_timesteps": 500,
        "gamma": 0.9,
        "env_kwargs": {"is_slippery": False, "map_name": "4x4"},
    }
    # One budget replaces the other, and arguments of the environment are put over one by one.
    assert large.settings == {
        "n_episodes": 7,
        "gamma": 0.8,
        "env_kwargs": {"is_slippery": False, "map_name": "8x8"},
    }


def test_an_environment_as_it_comes_is_trained_on_as_it_is_judged_on(read, tmp_path):
    study = read(
        "agents: {ppo: {}, own: {algo: ppo, train_env_kwargs: {slip: 0.1}}}\n"
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


def test_sweeps_multiply(read):
    study = read(
        "environments: [Taxi-v4]\n"
        "sweep: {gamma: [0.9, 0.99], learning_rate: [0.1, 0.5]}\n"
        "agents:\n  qlearning:\n  sarsa:\n    sweep: {gamma: [0.5]}\n"
    )
    assert [agent.label for agent in study.agents] == [
        "qlearning with γ = 0.9 with α = 0.1",
        "qlearning with γ = 0.9 with α = 0.5",
        "qlearning with γ = 0.99 with α = 0.1",
        "qlearning with γ = 0.99 with α = 0.5",
        "sarsa with γ = 0.5 with α = 0.1",
        "sarsa with γ = 0.5 with α = 0.5",
    ]
    assert study.agents[2].settings == {"gamma": 0.99, "learning_rate": 0.1}


@pytest.mark.parametrize(
    ("sweep", "labels", "folder"),
    [
        (
            {"exploration_initial_eps": [0.2, 1.0]},
            ["ε = 0.2", "ε = 1"],
            "epsilon=0.2",
        ),
        ({"learning_rate": [0.00006103515625, 0.5]}, ["α = 6.104e-05", "α = 0.5"], ""),
        ({"gamma": [0.99991, 0.99992]}, ["γ = 0.99991", "γ = 0.99992"], "gamma=0.99991"),
        ({"n_steps": [1, 4]}, ["n_steps = 1", "n_steps = 4"], "n_steps=1"),
        (
            {"learning_rate": [0.1], "kappa": [0.5, 1]},
            ["α = 0.1 with κ = 0.5", "α = 0.1 with κ = 1"],
            "alpha=0.1_with_kappa=0.5",
        ),
    ],
)
def test_alone_an_agent_is_labelled_by_what_is_swept(read, sweep, labels, folder):
    study = read(
        f"environments: [Taxi-v4]\nagents: {{as printed: {{algo: sarsa, sweep: {sweep}}}}}\n"
    )
    assert [agent.label for agent in study.agents] == labels
    assert folder in ("", file_name(labels[0]))


NAMES = st.text("abcdef_", min_size=1, max_size=6)
VALUES = st.integers() | st.floats(allow_nan=False) | st.booleans()


@given(st.dictionaries(NAMES, st.lists(VALUES, min_size=1, max_size=3), max_size=3))
def test_a_sweep_has_each_combination_once(sweep):
    agents = swept(AgentSpec("one", "qlearning", {"kept": 1}), sweep)
    size = 1
    for values in sweep.values():
        size *= len(values)
    assert len(agents) == size
    for agent in agents:
        assert agent.settings["kept"] == 1
        assert all(agent.settings[name] in values for name, values in sweep.items())
    assert len({agent.label for agent in agents}) == len({str(a.swept) for a in agents})


def test_a_sweep_is_counted_before_it_is_made(read):
    values = f"[{', '.join(map(str, range(100)))}]"
    sweep = ", ".join(f"{name}: {values}" for name in "abcdef")
    with pytest.raises(UserError, match=r":4: 1,000,000,000,001 agents up to here; .* 10,000 at"):
        read(f"environments: [Taxi-v4]\nagents:\n  sarsa:\n  qlearning:\n    sweep: {{{sweep}}}\n")


def test_a_swept_budget_replaces_the_other():
    agent = AgentSpec("one", "qlearning", {"n_timesteps": 500})
    assert [a.settings for a in swept(agent, {"n_episodes": [5, 9]})] == [
        {"n_episodes": 5},
        {"n_episodes": 9},
    ]


@given(
    st.dictionaries(st.sampled_from(["gamma", "n_timesteps", "n_episodes"]), VALUES),
    st.dictionaries(st.sampled_from(["gamma", "n_timesteps", "n_episodes"]), VALUES),
    st.dictionaries(NAMES, VALUES),
    st.dictionaries(NAMES, VALUES),
)
def test_later_settings_win(settings, changes, kwargs, changed_kwargs):
    result = layered({**settings, "env_kwargs": kwargs}, {**changes, "env_kwargs": changed_kwargs})
    assert {key: result[key] for key in changes} == changes
    assert result["env_kwargs"] == {**kwargs, **changed_kwargs}
    if {"n_timesteps", "n_episodes"} & set(changes):
        assert {"n_timesteps", "n_episodes"} & set(result) <= set(changes)


def test_quick_has_fewer_seeds_and_a_folder_of_its_own(read):
    study = read(BASE + "seeds: 30\nquick: {seeds: 4}\n")
    quick = study.quickened()
    assert (quick.name, quick.n_seeds, quick.is_quick) == ("lakes-quick", 4, True)
    assert read(BASE + "seeds: 1\n").quickened().n_seeds == 1


def test_seeds_may_begin_anywhere(read):
    assert read(BASE + "seeds: 3\n").seeds == range(3)
    assert read(BASE + "seeds: {first: 1000, count: 4}\n").seeds == range(1000, 1004)
    assert read(BASE + "seeds: {first: 7}\n").seeds == range(7, 17)
    for wrong in ("{first: -1}", "{count: 0}", "{last: 3}", "[1, 2]"):
        with pytest.raises(UserError, match="seeds"):
            read(BASE + f"seeds: {wrong}\n")


def test_every_metric_and_every_agent_is_known(read):
    for metric in METRICS:
        assert read(BASE + f"metric: {metric}\n").metric == metric
    names = ", ".join(ALGORITHMS)
    assert len(read(f"agents: [{names}]\nenvironments: [Taxi-v4]\n").agents) == len(ALGORITHMS)


@given(st.text() | st.text(min_size=99, max_size=300) | st.sampled_from(["CON", "nul.x", "a."]))
def test_a_label_makes_a_plain_file_name(label):
    name = file_name(label)
    assert name == file_name(name) == portable_name(name)
    assert re.fullmatch(r"[\w.=+,-]+", name)
    assert name not in (".", "..")


@pytest.mark.parametrize(
    "label", ["qlearning", "Eis_glatt", "ε=0.1, k", "qlearning learning_rate=0.01, gamma=0.9"]
)
def test_ordinary_labels_keep_the_folders_that_they_had(label):
    assert file_name(label) == re.sub(r"[^\w.=+,-]+", "_", label)


def test_a_shipped_study_is_found_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = Path(study.__file__).resolve().parents[1] / "studies" / "mine-maze.yml"
    for given_name in ("mine-maze", "mine-maze.yml", "studies/mine-maze.yml", "./mine-maze.yml"):
        assert find_study(given_name) == shipped
    assert read_study(shipped).name == "mine-maze"
    # A file of the user's own comes first, and elsewhere ours are not looked for.
    Path("mine-maze.yml").touch()
    assert find_study("mine-maze.yml") == Path("mine-maze.yml")
    assert find_study("mine-maze") == shipped
    assert find_study("other/mine-maze.yml") == Path("other/mine-maze.yml")
    with pytest.raises(UserError, match=r"mine-mase: cannot be read: .* did you mean 'mine-maze'"):
        find_study("mine-mase")


def test_an_agent_has_a_file_of_settings_beside_the_study(read, tmp_path):
    (tmp_path / "mine.yml").write_text("FrozenLake-v1: {n_timesteps: 7, gamma: 0.5}\n")
    study = read(
        "environments: [FrozenLake-v1]\ntuned: false\nagents:\n  sarsa: {n_timesteps: 9}\n"
        "  mine: {algo: sarsa, conf_file: mine.yml, learning_rate: 0.25}\n"
    )
    assert [agent.conf_file for agent in study.agents] == [None, tmp_path / "mine.yml"]
    raws = [run.spec.saved_hyperparams for run in plan(study, tmp_path) if run.seed == 0]
    assert raws == [
        {"n_timesteps": 9},
        {"n_timesteps": 7, "gamma": 0.5, "learning_rate": 0.25},
    ]


@pytest.mark.parametrize(
    ("line", "seconds", "memory"),
    [
        ("run_timeout: 10m", 600, None),
        ("run_timeout: 90", 90, None),
        ("run_memory: 1.5GB", None, 1_500_000_000),
        ("run_memory: 2000000000", None, 2_000_000_000),
    ],
)
def test_limits_of_runs(tmp_path, line, seconds, memory):
    path = tmp_path / "s.yml"
    path.write_text(f"{line}\nagents: [qlearning]\nenvironments: [FrozenLake-v1]\n")
    study = read_study(path)
    assert (study.run_timeout, study.run_memory) == (seconds, memory)


@pytest.mark.parametrize("line", ["run_timeout: -1", "run_timeout: [1]", "run_memory: 4"])
def test_limits_that_are_none(tmp_path, line):
    path = tmp_path / "s.yml"
    path.write_text(f"{line}\nagents: [qlearning]\nenvironments: [FrozenLake-v1]\n")
    with pytest.raises(UserError, match=r"s\.yml:1: run_\w+ must be a (time|size)"):
        read_study(path)


SHIPPED = Path(study.__file__).parents[1] / "studies"


@pytest.mark.parametrize("path", sorted(SHIPPED.rglob("*.yml")), ids=lambda path: path.stem)
def test_what_is_written_asks_for_the_same(path, tmp_path):
    if path.parent.name == "search":
        return
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
    read_map = {"desc": ["S.", ".G"], "slip": 0.1}
    wanted = [{**settings, "env_kwargs": read_map} for settings in changed]
    assert [agent.settings for agent in again.agents] == wanted
    assert again.agents[2].conf_file.read_text() == "default:\n  n_timesteps: 9\n"
    assert again.agents[2].conf_file.parent == tmp_path / "there" / "settings"
    write_study(tmp_path, study.quickened())
    assert not (tmp_path / "study.yml").exists()

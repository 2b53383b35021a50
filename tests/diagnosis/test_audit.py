"""`audit`: planted faults are named, what is right passes, and mistakes end in one line."""

import json
import sys

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from commands.audit import KINDS, main
from commands.cli import run_command
from diagnosis import probes, subjects
from diagnosis.audit import TITLES, Verdict, audit
from diagnosis.faults import FAULTS
from diagnosis.probe_worlds import Record, World, make_env
from diagnosis.probes import Finding, watkins_table
from diagnosis.subjects import GAMMA, ClassSubject, ScriptSubject, class_named
from tests.diagnosis import planted_classes, planted_tables


def verdict_on(subject, probe):
    return Verdict(subject.name, tuple(audit(subject, range(3), [probe])))


# --- what is found --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*planted_tables.FAULTS, *planted_tables.RIGHT])
def test_faults_of_tables_are_named_and_right_ones_pass(name):
    subject = ScriptSubject(name, getattr(planted_tables, name), {}, planted_tables.KINDS.get(name))
    probed, seeds = probes.PROBES, range(1)
    if name.startswith("memory"):  # which are slow
        subject.steps, probed, seeds = 1000, [probes.probe_age, probes.probe_copies], range(3)
    findings, fault = audit(subject, seeds, probed), planted_tables.FAULTS.get(name)
    if fault:  # what comes first is what is wrong
        assert next((finding.fault for finding in findings if finding.fault), None) == fault
    else:
        assert {finding.state for finding in findings} <= {"ok", "skipped"}


@pytest.mark.parametrize(
    ("name", "right", "probe"),
    [
        ("DQNWithoutOptimizer", "dqn", probes.probe_files),
        ("PPORatio", "ppo", probes.probe_ratio),
        ("PPOTraces", None, probes.probe_traces),
        ("PPOEntropy", None, probes.probe_entropy),
        ("DQNNeverCopies", None, probes.probe_discount),
        ("DQNAlwaysCopies", "dqn", probes.probe_target_network),
        ("ForgetfulPPO", None, probes.probe_files),
        ("ForgetfulQLearning", None, probes.probe_files),
        ("DQNSharesMemory", "dqn", probes.probe_seeds),
    ],
)
def test_faults_of_classes_are_named(name, right, probe, monkeypatch):
    """Where values do not settle the steps are doubled, which would take minutes."""
    monkeypatch.setattr(probes, "MOST_DOUBLINGS", 1)
    accused = ClassSubject(name, getattr(planted_classes, name), {})
    assert {f.fault for f in audit(accused, [0], [probe]) if f.fault} == {
        planted_classes.FAULTS[name]
    }
    if right:
        passed = ClassSubject(right, class_named(right), {})
        assert {f.state for f in audit(passed, [0], [probe])} == {"ok"}


def test_observations_changed_in_place_are_the_librarys_affair():
    """DummyVecEnv keeps no copy of an episode's last observation: no fault of any agent."""
    subject = ClassSubject("dqn", class_named("dqn"), {})
    subject.steps = 300
    finding = list(audit(subject, [0], [probes.probe_copies]))
    assert [each.state for each in finding] == ["ok"]
    assert "DummyVecEnv" in finding[0].text


# --- when nothing is said -------------------------------------------------------------------------


def restless(make_env, seed, gamma, steps):
    """Values that never come to rest."""
    agent = planted_tables.q_right(make_env, seed, gamma, steps)
    agent.values = lambda obs: np.full(2, float(steps))
    return agent


def shifted(make_env, seed, gamma, steps):
    """Values that no fault explains."""
    agent = planted_tables.q_right(make_env, seed, gamma, steps)
    table = agent.table + 3.0
    agent.values = lambda obs: table[planted_tables.number(obs)]
    return agent


UNSAID = [
    (restless, None, probes.probe_ends, "unsaid", "did not settle"),
    (shifted, "q_learning", probes.probe_ends, "unsaid",
     "4.00 and not 1: no fault known here explains it"),
    # What it claims to be has to be known.
    (planted_tables.q_right, None, probes.probe_next_action, "skipped", "--kind"),
]  # fmt: skip


@pytest.mark.parametrize(("train", "kind", "probe", "state", "said"), UNSAID)
def test_no_verdict_where_nothing_is_known(train, kind, probe, state, said):
    verdict = verdict_on(ScriptSubject("?", train, {}, kind), probe)
    assert {(finding.state, finding.fault) for finding in verdict.findings} == {(state, "")}
    assert said in verdict.findings[0].text
    assert verdict.exit_code == 2


def test_seeds_that_disagree_decide_nothing(monkeypatch):
    def moody(lab):
        state = ("fault", "ok", "unsaid")[lab.seed]
        yield Finding("a probe", state, "", "traces" if state == "fault" else "")

    monkeypatch.setitem(TITLES, moody, "a probe")  # which the page of probes does not list
    found = list(audit(ScriptSubject("moody", planted_tables.q_right, {}), range(3), [moody]))
    assert [(f.state, f.text) for f in found] == [("unsaid", "seeds disagree: ok, traces, unsaid")]


# --- worlds and tables by hand --------------------------------------------------------------------


def test_values_of_worlds():
    assert World(((0, 0), (1, 1))).values(0.8).tolist() == [0.8, 1.0]
    assert World(((0, 0), (1, -4)), quits=0.5).values(0.8).tolist() == [0.4, 1.0]
    loop = World(((5, 5), (1, 1)), ends=False, cut=4)
    np.testing.assert_allclose(loop.values(0.8), [9, 5])


@pytest.mark.parametrize("observations", ["discrete", "box"])
def test_worlds_are_gymnasium_environments(observations):
    world, record = World(((0, 0), (1, -1)), cut=3), Record(2)
    env = make_env(world, record, observations, "discrete")
    check_env(env.unwrapped, skip_render_check=True)
    record.states.clear()
    record.actions.clear()
    env.reset(seed=0)
    assert [env.step(0)[1:4], env.step(1)[1:4]] == [(0, False, False), (-1, True, False)]
    assert record.counts().tolist() == [[1, 0], [0, 1]]
    for in_place in (False, True):  # what is shown in place is one array
        env = make_env(World(((0, 0),), in_place=in_place), Record(1), "box", "discrete")
        first, _ = env.reset()
        assert (env.step(0)[0] is first) is in_place


def test_a_table_of_watkins_by_hand():
    """Two episodes; in the second, exploring in the middle state cuts what led there."""
    world = World(((0, 0), (1, -1), (1, 1)))
    record = Record(3, [0, 1, 2, 0, 1, 2], [0, 0, 0, 0, 1, 0], [0, 1, 1, 0, -1, 1])
    first = [0.5 * 0.4 * 1 + 0.5 * 0.16 * 1, 0.5 + 0.5 * 0.4, 0.5]
    cut = watkins_table(world, record, 0.5, is_cut=True)
    whole = watkins_table(world, record, 0.5, is_cut=False)
    start = first[0] + 0.5 * (GAMMA * first[1] - first[0])
    np.testing.assert_allclose(cut[:, 0], [start, first[1], 0.75])
    error = -1 + GAMMA * first[2]
    moved = start + 0.5 * (0.4 * error + 0.16 * 0.5)
    np.testing.assert_allclose(whole[:, 0], [moved, first[1], 0.75])


def test_every_fault_has_a_sentence_and_a_source():
    assert len(FAULTS) == 24
    for fault in FAULTS.values():
        assert fault.sentence.endswith(".")
        assert fault.source
    assert set(planted_tables.FAULTS.values()) | set(planted_classes.FAULTS.values()) == set(FAULTS)
    assert tuple(subjects.KINDS) == KINDS


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture
def type_audit(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["audit.py", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            run_command(main)
        captured = capsys.readouterr()
        return stop.value.code, captured.out, captured.err

    return run


SCRIPT = '''
import numpy as np


def train(make_env, seed, gamma, steps):
    """Q-learning in which an episode that is cut off counts as ended."""
    rng, env = np.random.default_rng(seed), make_env()
    q = np.zeros((env.observation_space.n, 2))
    obs, _ = env.reset(seed=seed)
    for _ in range(steps):
        action = int(rng.integers(2)) if rng.random() < 0.5 else int(q[obs].argmax())
        following, reward, terminated, truncated, _ = env.step(action)
        done = terminated or truncated
        q[obs, action] += 0.1 * (reward + gamma * q[following].max() * (not done) - q[obs, action])
        obs = env.reset()[0] if done else following

    class Agent:
        def act(self, obs):
            return int(q[obs].argmax())

        def values(self, obs):
            return q[obs]

    return Agent()


number = 3
'''


def test_a_script_of_ones_own(type_audit, tmp_path):
    (tmp_path / "my_audited_script.py").write_text(SCRIPT)
    words = ("--script", "my_audited_script:train", "--kind", "q_learning", "--json", "out.json")
    code, out, err = type_audit(*words)
    assert (code, err) == (1, "")
    assert "an episode that is cut off          FAULT\n" in out
    assert "\nfault: no-bootstrap-at-truncation. A truncated episode is treated as " in out
    assert "right would be: 5 in both" in " ".join(out.split())
    found = json.loads((tmp_path / "out.json").read_text())
    assert (found["verdict"], found["fault"]) == ("fault", "no-bootstrap-at-truncation")
    assert found["faults"][0]["source"].startswith("Pardo et al. (2018)")


def test_a_class_of_ones_own(type_audit, tmp_path, monkeypatch):
    text = "from agents.tabular.one_step import QLearning\n\n\nclass Mine(QLearning):\n    pass\n"
    (tmp_path / "my_audited_agents.py").write_text(text)
    monkeypatch.setattr(audit, "__defaults__", ((probes.probe_ends, probes.probe_discount),))
    flags = ("--gym-packages", "my_audited_agents.py", "-params", "learning_rate:0.1")
    code, out, err = type_audit("--algo", "my_audited_agents:Mine", *flags)
    assert (code, err) == (0, "")
    assert out.endswith(
        "audit of my_audited_agents:Mine\n"
        "  the end of an episode               ok\n"
        "  the discount                        ok\n"
        "right, as far as these probes see\n"
    )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("", "one of the arguments --algo --script is required"),
        ("--algo qlerning", "did you mean 'qlearning'?"),
        ("--algo ucb", "--algo ucb: it is for bandits"),
        ("--algo qlearning -params gama:0.5", "unknown hyperparameter 'gama'"),
        ("--algo qlearning --json .", "--json: . is no place for a file"),
        ("--algo my_refused:number", "number is no subclass of Stable-Baselines3's BaseAlgorithm"),
        ("--script my_refused:bare", "must take make_env, seed, gamma, steps"),
        ("--script my_refused:train -params alpha:1", "unknown argument of my_refused:train"),
        ("--script my_refused:broken", "cannot train on a tiny world: ZeroDivisionError"),
        ("--script my_refused:empty", "must return something with act(obs)"),
        ("--script my_refused:train --engine auto", "--engine: a script has none"),
    ],
)
def test_mistakes_end_in_one_line(type_audit, tmp_path, words, told):
    broken = "\n\ndef broken(make_env, seed, gamma, steps):\n    1 / 0\n"
    broken += "\n\ndef empty(make_env, seed, gamma, steps):\n    return None\n"
    name = tmp_path.name  # another one each time: modules stay imported
    (tmp_path / f"{name}.py").write_text(f"{SCRIPT}\n\ndef bare():\n    pass\n{broken}")
    code, out, err = type_audit(*words.replace("my_refused", name).split())
    assert (code, out) == (2, "")
    assert told.replace("my_refused", name) in err
    assert len(err.splitlines()) == 1

"""`audit`: planted faults are named, what is right passes, and mistakes end in one line."""

import json
import sys
from functools import partial

import numpy as np
import pytest
from rl_yardstick.diagnosis.probes import Finding, watkins_table

from rl_yardstick.commands.audit import KINDS, main
from rl_yardstick.commands.cli import run_command
from rl_yardstick.diagnosis import probes, subjects
from rl_yardstick.diagnosis.audit import TITLES, Verdict, audit
from rl_yardstick.diagnosis.faults import FAULTS
from rl_yardstick.diagnosis.probe_worlds import Record, World
from rl_yardstick.diagnosis.subjects import GAMMA, ClassSubject, ScriptSubject, class_named
from tests.diagnosis import planted_classes
from tests.diagnosis.planted_tables import (
    from_memory,
    number,
    one_step,
    preferences,
    several_steps,
    with_traces,
)

q_learning, sarsa = partial(one_step, target="max"), partial(one_step, target="next")
sarsa_lambda = partial(with_traces, target="next")


QUICK = {"policy_kwargs": {"net_arch": []}, "learning_rate": 0.03, "batch_size": 32}
QUICK |= {"target_update_interval": 10, "learning_starts": 10, "train_freq": 1}


def script(train, kind=None):
    """A function to audit, on fewer steps than usual."""
    subject = ScriptSubject("a script", train, {}, kind)
    subject.steps = 500 if subject.accepts("buffer_size") else 1000
    return subject


def of_class(name, cls):
    """A class to audit, with settings under which tiny worlds are learnt in few steps."""
    is_dqn = "dqn" in name.lower()
    subject = ClassSubject(name, cls, QUICK if is_dqn else {})
    subject.steps = 100 if is_dqn else subject.steps
    return subject


# --- what is found --------------------------------------------------------------------------------

OF_TABLES = {  # the fault: what has it, what that claims to be, and the probe that sees it
    "bootstraps-at-terminal": (q_learning, "q_learning", probes.probe_ends),
    "discount-twice": (q_learning, "q_learning", probes.probe_discount),
    "discount-missing": (sarsa, "sarsa", probes.probe_discount),
    "reset-observation": (q_learning, "q_learning", probes.probe_cuts),
    "follows-instead-of-maximises": (sarsa, "q_learning", probes.probe_next_action),
    "maximises-instead-of-follows": (q_learning, "sarsa", probes.probe_next_action),
    "explores-in-evaluation": (q_learning, "q_learning", probes.probe_choice),
    "global-generator": (q_learning, "q_learning", probes.probe_seeds),
    "not-reproducible": (sarsa, "sarsa", probes.probe_seeds),
    "schedule-backwards": (q_learning, "q_learning", probes.probe_schedules),
    "schedule-constant": (q_learning, "q_learning", probes.probe_schedules),
    "shared-buffer": (from_memory, "q_learning", probes.probe_copies),
    "stale-buffer": (from_memory, "q_learning", probes.probe_age),
    "n-step-return": (several_steps, "sarsa", probes.probe_n_steps),
    "traces, never-cut": (with_traces, "q_learning", probes.probe_traces),
    "traces, lambda-alone": (sarsa_lambda, "sarsa", probes.probe_traces),
    "traces, kept-across-episodes": (sarsa_lambda, "sarsa", probes.probe_traces),
    "advantage-sign": (preferences, "actor_critic", probes.probe_choice),
}
OF_CLASSES = {  # a class: its fault, and the probe that sees it
    "DQNNeverCopies": ("target-never-copied", probes.probe_discount),
    "DQNAlwaysCopies": ("target-always-copied", probes.probe_target_network),
    "DQNSharesMemory": ("shared-buffer", probes.probe_seeds),
    "DQNWithoutOptimizer": ("zip-forgets-optimizer", probes.probe_files),
    "ForgetfulDQN": ("zip-forgets-tables", probes.probe_files),
    "ForgetfulPPO": ("zip-forgets-schedules", probes.probe_files),
    "PPORatio": ("importance-ratio", probes.probe_ratio),
    "PPOTraces": ("traces", probes.probe_traces),
    "PPOEntropy": ("entropy-sign", probes.probe_entropy),
}
RIGHT_CLASSES = {
    "dqn": (probes.probe_target_network, probes.probe_copies, probes.probe_files),
    "ppo": (probes.probe_ratio,),
}


def test_each_fault_is_planted_once():
    planted = {row.partition(",")[0] for row in OF_TABLES}
    planted |= {fault for fault, _ in OF_CLASSES.values()}
    assert {*planted, "no-bootstrap-at-truncation"} == set(FAULTS)  # which SCRIPT has
    assert tuple(subjects.KINDS) == KINDS


@pytest.mark.parametrize("row", OF_TABLES)
def test_faults_of_tables_are_named(row):
    (train, kind, probe), (name, _, way) = OF_TABLES[row], row.partition(", ")
    faulty = script(partial(train, fault=way or name), kind)
    assert {finding.fault for finding in audit(faulty, [0], [probe])} == {name}


RIGHT = {
    "Q-learning": (q_learning, "q_learning"),
    "Expected SARSA": (partial(one_step, target="expected"), "expected_sarsa"),
    "a memory": (from_memory, "q_learning"),
    "n steps": (several_steps, "sarsa"),
    "Q(lambda)": (with_traces, "q_learning"),
    "actor-critic": (preferences, "actor_critic"),
}


@pytest.mark.parametrize("row", RIGHT)
def test_right_tables_pass_all_probes(row):
    findings = list(audit(script(*RIGHT[row]), [0]))
    assert {finding.state for finding in findings} <= {"ok", "skipped"}
    assert Verdict(row, tuple(findings)).exit_code == 0


@pytest.mark.parametrize("name", OF_CLASSES)
def test_faults_of_classes_are_named(name):
    fault, probe = OF_CLASSES[name]
    accused = of_class(name, getattr(planted_classes, name))
    assert {found.fault for found in audit(accused, [0], [probe]) if found.fault} == {fault}


@pytest.mark.parametrize("name", RIGHT_CLASSES)
def test_right_classes_pass(name):
    """DQN too where DummyVecEnv keeps no copy of an episode's last observation."""
    passed = of_class(name, class_named(name))
    assert {found.state for found in audit(passed, [0], RIGHT_CLASSES[name])} == {"ok"}


# --- when nothing is said -------------------------------------------------------------------------


def restless(make_env, seed, gamma, steps):
    """Values that never come to rest."""
    agent = q_learning(make_env, seed, gamma, steps)
    agent.values = lambda obs: np.full(2, float(steps))
    return agent


def shifted(make_env, seed, gamma, steps):
    """Values that no fault explains."""
    agent = q_learning(make_env, seed, gamma, steps)
    agent.values = lambda obs: agent.table[number(obs)] + 3
    return agent


@pytest.mark.parametrize(
    ("train", "said"),
    [(restless, "did not settle"), (shifted, "4.00 and not 1: no fault known here explains it")],
)
def test_no_verdict_where_nothing_is_known(train, said):
    findings = tuple(audit(script(train, "q_learning"), [0], [probes.probe_ends]))
    assert [(finding.state, finding.fault) for finding in findings] == [("unsaid", "")]
    assert said in findings[0].text
    assert Verdict("?", findings).exit_code == 2


def test_seeds_that_disagree_decide_nothing(monkeypatch):
    def moody(lab):
        state = ("fault", "ok", "unsaid")[lab.seed]
        yield Finding("a probe", state, "", "traces" if state == "fault" else "")

    monkeypatch.setitem(TITLES, moody, "a probe")  # which the page of probes does not list
    found = list(audit(script(q_learning), range(3), [moody]))
    assert [(f.state, f.text) for f in found] == [("unsaid", "seeds disagree: ok, traces, unsaid")]


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


def bare():
    pass


def broken(make_env, seed, gamma, steps):
    1 / 0
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
    text = "from rl_yardstick.agents.tabular.one_step import QLearning\n\nMine = QLearning\n"
    (tmp_path / "my_audited_agents.py").write_text(text)
    monkeypatch.setattr(audit, "__defaults__", ((probes.probe_ends, probes.probe_discount),))
    words = ("--algo", "my_audited_agents:Mine", "--gym-packages", "my_audited_agents.py")
    code, out, err = type_audit(*words)
    assert (code, err) == (0, "")
    assert out.endswith("right, as far as these probes see\n")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--algo qlerning", "did you mean 'qlearning'?"),
        ("--algo ucb", "--algo ucb: it is for bandits"),
        ("--algo qlearning -params gama:0.5", "unknown hyperparameter 'gama'"),
        ("--algo my_refused:number", "number is no subclass of Stable-Baselines3's BaseAlgorithm"),
        ("--script my_refused:bare", "must take make_env, seed, gamma, steps"),
        ("--script my_refused:broken", "cannot train on a tiny world: ZeroDivisionError"),
    ],
)
def test_mistakes_end_in_one_line(type_audit, tmp_path, words, told):
    name = tmp_path.name  # another one each time: modules stay imported
    (tmp_path / f"{name}.py").write_text(SCRIPT)
    code, out, err = type_audit(*words.replace("my_refused", name).split())
    assert (code, out) == (2, "")
    assert told in err
    assert len(err.splitlines()) == 1


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

"""`audit`: planted faults are named, what is right passes, and mistakes end in one line."""

from functools import partial

import numpy as np
import pytest

from rl_yardstick.diagnosis import agent_probes, target_probes
from rl_yardstick.diagnosis.audit import Verdict, audit
from rl_yardstick.diagnosis.faults import FAULTS, Finding
from rl_yardstick.diagnosis.subjects import ClassSubject, ScriptSubject
from rl_yardstick.pipeline.components import agent_name, import_modules
from tests.diagnosis import planted

q_learning, sarsa = (partial(planted.one_step, target=target) for target in ("max", "next"))

QUICK = {"policy_kwargs": {"net_arch": []}, "learning_rate": 0.03, "batch_size": 32}
QUICK |= {"target_update_interval": 10, "learning_starts": 10, "train_freq": 1}


def script(train, kind=None):
    """A function to audit, on fewer steps than usual."""
    subject = ScriptSubject("a script", train, {}, kind)
    subject.steps = 500 if subject.accepts("buffer_size") else 1000
    return subject


def of_class(name):
    """A class to audit, with settings under which tiny worlds are learnt in few steps."""
    is_dqn = "dqn" in name.lower()
    if ":" in name:
        import_modules([name])
    subject = ClassSubject(agent_name(name), QUICK if is_dqn else {})
    subject.steps = 100 if is_dqn else subject.steps
    return subject


OF_TABLES = {  # the fault: what has it, what that claims to be, and the probe that sees it
    "bootstraps-at-terminal": (q_learning, "q_learning", target_probes.probe_ends),
    "discount-twice": (q_learning, "q_learning", target_probes.probe_discount),
    "discount-missing": (sarsa, "sarsa", target_probes.probe_discount),
    "reset-observation": (q_learning, "q_learning", target_probes.probe_cuts),
    "follows-instead-of-maximises": (sarsa, "q_learning", target_probes.probe_next_action),
    "maximises-instead-of-follows": (q_learning, "sarsa", target_probes.probe_next_action),
    "explores-in-evaluation": (q_learning, "q_learning", agent_probes.probe_choice),
    "global-generator": (q_learning, "q_learning", agent_probes.probe_seeds),
    "not-reproducible": (sarsa, "sarsa", agent_probes.probe_seeds),
    "schedule-backwards": (q_learning, "q_learning", agent_probes.probe_exploration),
    "schedule-constant": (q_learning, "q_learning", agent_probes.probe_exploration),
    "stale-buffer": (planted.from_memory, "q_learning", target_probes.probe_age),
    "n-step-return": (planted.several_steps, "sarsa", target_probes.probe_n_steps),
    "traces, lambda-alone": (sarsa, "sarsa", target_probes.probe_traces),
    "traces, kept-across-episodes": (sarsa, "sarsa", target_probes.probe_traces),
    "advantage-sign": (planted.preferences, "actor_critic", agent_probes.probe_choice),
}
OF_CLASSES = {  # a class: its fault, and the probe that sees it
    "DQNNeverCopies": ("target-never-copied", target_probes.probe_discount),
    "DQNAlwaysCopies": ("target-always-copied", target_probes.probe_target_network),
    "DQNSharesMemory": ("shared-buffer", agent_probes.probe_seeds),
    "DQNWithoutOptimizer": ("zip-forgets-optimizer", agent_probes.probe_files),
    "ForgetfulDQN": ("zip-forgets-tables", agent_probes.probe_files),
    "ForgetfulPPO": ("zip-forgets-schedules", agent_probes.probe_files),
    "PPORatio": ("importance-ratio", target_probes.probe_ratio),
    "PPOTraces": ("traces", target_probes.probe_advantages),
    "PPOEntropy": ("entropy-sign", agent_probes.probe_entropy),
}
RIGHT_CLASSES = [("dqn", target_probes.probe_target_network), ("dqn", agent_probes.probe_files)]
RIGHT_CLASSES += [("ppo", target_probes.probe_ratio)]


def test_each_fault_is_planted_once():
    known = {row.partition(",")[0] for row in OF_TABLES}
    known |= {fault for fault, _ in OF_CLASSES.values()}
    assert {*known, "no-bootstrap-at-truncation"} == set(FAULTS)  # which SCRIPT has


@pytest.mark.parametrize("row", OF_TABLES)
def test_faults_of_tables_are_named(row):
    (train, kind, probe), (name, _, way) = OF_TABLES[row], row.partition(", ")
    faulty = script(partial(train, fault=way or name), kind)
    assert {finding.fault for finding in audit(faulty, [0], [probe])} == {name}


RIGHT = {
    "Q-learning": (q_learning, "q_learning"),
    "Expected SARSA": (partial(planted.one_step, target="expected"), "expected_sarsa"),
    "a memory": (planted.from_memory, "q_learning"),
    "n steps": (planted.several_steps, "sarsa"),
    "actor-critic": (planted.preferences, "actor_critic"),
}


@pytest.mark.parametrize("row", RIGHT)
def test_right_tables_pass_all_probes(row):
    findings = list(audit(script(*RIGHT[row]), [0]))
    assert {finding.state for finding in findings} <= {"ok", "skipped"}
    assert Verdict(row, tuple(findings)).exit_code == 0


@pytest.mark.parametrize("name", OF_CLASSES)
def test_faults_of_classes_are_named(name):
    fault, probe = OF_CLASSES[name]
    accused = of_class(f"{planted.__name__}:{name}")
    assert {found.fault for found in audit(accused, [0], [probe]) if found.fault} == {fault}


@pytest.mark.parametrize(("name", "probe"), RIGHT_CLASSES)
def test_right_classes_pass(name, probe):
    assert [found.state for found in audit(of_class(name), [0], [probe])] == ["ok"]


UNSAID = [  # values by the table's and the steps, and what is said of them
    (lambda values, steps: np.full(2, float(steps)), "did not settle"),
    (lambda values, steps: values + 3, "4.00 and not 1: no fault known here explains it"),
]


@pytest.mark.parametrize(("shown", "said"), UNSAID)
def test_no_verdict_where_nothing_is_known(shown, said):
    def train(make_env, seed, gamma, steps):
        agent = q_learning(make_env, seed, gamma, steps)
        agent.values = lambda obs: shown(agent.table[planted.number(obs)], steps)
        return agent

    findings = tuple(audit(script(train, "q_learning"), [0], [target_probes.probe_ends]))
    assert [(finding.state, finding.fault) for finding in findings] == [("unsaid", "")]
    assert said in findings[0].text
    assert Verdict("?", findings).exit_code == 2


def test_seeds_that_disagree_decide_nothing():
    def moody(lab):
        state = ("fault", "ok", "unsaid")[lab.seed]
        return Finding(state, "", "traces" if state == "fault" else "")

    found = list(audit(script(q_learning), range(3), [moody]))
    assert [(f.state, f.text) for f in found] == [("unsaid", "seeds disagree: ok, traces, unsaid")]

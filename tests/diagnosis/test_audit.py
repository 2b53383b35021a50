"""`audit`: planted faults are named, what is right passes, and what cannot be read says so."""

import pytest

from rl_yardstick.diagnosis.audit import audit
from rl_yardstick.diagnosis.subjects import ClassSubject, ScriptSubject
from rl_yardstick.pipeline.components import class_name, import_modules
from tests.diagnosis.planted import FAULTS, PROGRAMS, text_of

# Rows of networks in scripts take half a minute; benchmarks/audit_faults.py has them.
QUICK = [row for row in FAULTS if row[0].startswith("sb3") or FAULTS.index(row) in (3, 13, 17, 18)]
QUICK += [row for row in FAULTS if row[0] == "sarsa"][:1]


@pytest.fixture
def verdict_on(tmp_path):
    """The verdict on a program with a replacement."""

    def on(program, old="", new="", tag=""):
        name, _ = PROGRAMS[program]
        path = tmp_path / f"audited_{program}{tag}.py"
        path.write_text(text_of(program, old, new))
        if name == "train":
            inside = {"__name__": "audited", "__doc__": "Q-learning"}
            exec(path.read_text(), inside)  # noqa: S102
            return audit(ScriptSubject(name, inside[name], {}), seeds=1)
        import_modules([f"{path}:{name}"])
        return audit(ClassSubject(class_name(f"{path}:{name}"), {}), seeds=1)

    return on


@pytest.mark.parametrize("row", QUICK, ids=lambda row: f"{row[0]}: {row[1] or row[3]}")
def test_faults_are_named(row, verdict_on):
    program, fault, old, new = row
    found = verdict_on(program, old, new, f"_{FAULTS.index(row)}")
    assert (found.state, found.exit_code) == ("wrong", 1)
    assert found.fault == fault, found.lines()


@pytest.mark.parametrize("program", ["table", "sarsa", "sb3_dqn", "sb3_ppo"])
def test_right_programs_pass(program, verdict_on):
    found = verdict_on(program, tag="_right")
    assert found.exit_code == 0, found.lines()
    assert found.target.startswith("target = 1.00 reward + 0.")
    assert "right would be" not in found.target


OWN_RULES = {
    "its own mix": ("(1 - self.tau).add_(self.tau * new)", "(0.97).add_(0.03 * new)"),
    "its own loss": ("smooth_l1_loss(q, target)", "th.log(th.cosh(q - target)).mean()"),
}


@pytest.mark.parametrize("name", OWN_RULES)
def test_rules_of_its_own_are_right_if_it_learns_what_is_right(name, verdict_on):
    assert verdict_on("sb3_dqn", *OWN_RULES[name], f"_own_{name[-4:].strip()}").state == "right"


def test_a_wrong_action_in_some_states_is_no_exploration(verdict_on):
    asked = "return int(q[obs].argmax())"
    found = verdict_on("table", asked, f"{asked} if obs != 13 else int(q[obs].argmin())")
    assert (found.state, found.fault) == ("wrong", "")


@pytest.mark.parametrize("name", ["dqn", "double_dqn", "deep_qlearning", "ppo", "a2c", "qlearning"])
def test_agents_of_the_library_pass(name):
    assert audit(ClassSubject(name, {}), seeds=1).lines()[1] == "right"


MEASURED = [  # the program, what is replaced, and the coefficients of next value and where cut off
    ("table", "reward + gamma * value", "reward + 0.5 * gamma * value", 0.4, 0.4),
    ("sb3_dqn", "self.gamma * ahead", "0.5 * self.gamma * ahead", 0.4, 0.4),
    ("sb3_ppo", "rewards[i] += self.gamma * ", "rewards[i] += ", 0.8, 1.0),
]


@pytest.mark.parametrize(("program", "old", "new", "following", "cut"), MEASURED)
def test_the_backup_is_measured(program, old, new, following, cut, verdict_on):
    found = verdict_on(program, old, new, "_measured")
    told = f"target = 1.00 reward + {following:.2f} next value + {cut:.2f} value where cut off; "
    assert found.lines()[0].startswith(f"{told}right would be")
    assert found.measured.next_value == pytest.approx(following, abs=0.01)
    assert found.measured.where_cut == pytest.approx(cut, abs=0.01)


def test_what_cannot_be_read_says_which_method_to_add(verdict_on):
    method = "        def values(self, obs):\n            return q[obs]\n"
    found = verdict_on("table", method)
    assert (found.state, found.exit_code) == ("unreadable", 2)
    assert "add the method values(obs)" in found.lines()[-1]


def test_the_best_action_of_the_own_state_is_not_called_another_fault(verdict_on):
    old, new = "q[following].max()", "q[following, q[obs].argmax()]"
    found = verdict_on("table", old, new, "_own_best")
    assert found.state == "wrong"
    assert not found.fault or "next-value-is-best-in-own-state" in found.fault


def test_settings_do_what_their_names_say(verdict_on):
    found = verdict_on("sarsa", "random() < self.epsilon", "random() > self.epsilon", "_inverted")
    assert found.fault == "exploration-inverted"
    # Five steps are more than an episode has, and two are not.
    found = verdict_on("n_step", "0.0 if terminated", "0.0 if not truncated", "_uncut")
    assert found.lines()[1] == "wrong: no known fault is near"
    assert "with n at 2, target = " in found.lines()[-1]
    assert verdict_on("n_step", tag="_right").state == "right"


def test_what_training_raises_is_told_and_what_the_audit_raises_is_not_caught(
    verdict_on, monkeypatch
):
    found = verdict_on("table", "epsilon = 0.5", "epsilon = 0.5 if step < 99 else 1 // 0", "_fails")
    assert (found.state, found.exit_code) == ("unreadable", 2)
    assert "it cannot train here: ZeroDivisionError" in found.lines()[-1]
    monkeypatch.setattr("rl_yardstick.diagnosis.audit.nearest", lambda *_: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        verdict_on("table", tag="_own_error")

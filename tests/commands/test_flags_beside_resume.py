"""What may be typed beside --resume: nothing that the run has already, not even as it has it."""

import pytest

from commands.train import build_parser

ALLOWED = {
    "--save-state-every": "30s",
    "--keep-state": None,
    "--gym-packages": "math",
    "--log-folder": "logs",
    "--verbose": "0",
    "--progress": None,
}
OTHERS = {
    "--engine": "auto",
    "--eval-freq": "5",
    "--eval-episodes": "5",
    "--hyperparams": "gamma:0.9",
    "--env-kwargs": "a:1",
    "--eval-env-kwargs": "a:1",
    "--conf-file": "some.yml",
    "--trained-agent": "some.zip",
    "--tensorboard-log": "logs",
}


def flags():
    """All flags, each with a value where it takes one: where it can be, what it is by default."""
    for action in build_parser()._actions:
        flag = action.option_strings[-1]
        if flag not in ("--help", "--list", "--resume"):
            value = ALLOWED.get(flag, OTHERS.get(flag, str(action.default)))
            yield flag, None if action.nargs == 0 else value


@pytest.mark.parametrize(("flag", "value"), list(flags()))
def test_every_flag_beside_resume(type_in_own_folder, own_folder, flag, value):
    (own_folder / "run").mkdir()
    words = [flag] if value is None else [flag, value]
    code, _, said = type_in_own_folder("train.py", "--resume", "run", *words)
    assert (code, said.count("\n")) == (2, 1)
    refusal = f"{flag} cannot be given with --resume: the run has its own"
    assert (refusal in said) == (flag not in ALLOWED), said
    assert not list((own_folder / "run").iterdir())


def test_which_run_is_said_by_its_folder_or_by_its_agent_and_environment(type_in_own_folder):
    code, _, said = type_in_own_folder("train.py", "--algo", "ppo", "--resume")
    assert (code, said.count("\n")) == (2, 1)
    assert "no run of ppo on CartPole-v1 in logs was interrupted" in said

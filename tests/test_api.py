"""The commands as Python functions: the same results, own classes, notebooks."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import nbformat
import pytest
from gymnasium.wrappers import TransformReward
from nbclient import NotebookClient
from stable_baselines3 import DQN

import rl_yardstick as ys
from rl_yardstick import agents, api
from rl_yardstick.commands.train import spec_from_flags
from rl_yardstick.experiments.pool import REGISTRATIONS
from rl_yardstick.pipeline.errors import UserError

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


class Line(gym.Env):
    observation_space, action_space = gym.spaces.Discrete(3), gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = 0
        return 0, {}

    def step(self, action):
        self.state += int(action)
        return self.state, float(action), self.state == 2, False, {}


class Learner(agents.load_algorithm("random")):
    """An agent of this module."""


@pytest.fixture(autouse=True)
def own_registrations(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    tables = [(table, dict(table)) for table in (agents.ALGORITHMS, gym.registry, REGISTRATIONS)]
    yield
    for table, before in tables:
        for name in table.keys() - before.keys():
            del table[name]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    logs = tmp_path_factory.mktemp("logs")
    return ys.train("FrozenLake-v1", "qlearning", n_timesteps=2000, seed=0, folder=logs)


def test_names_are_listed_and_nothing_is_imported_for_them():
    code = "import rl_yardstick as ys, sys; print(*ys.__all__, len(sys.modules)); ys.nothing"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    *names, n_modules = done.stdout.split()
    assert {*names} == {*ys.__all__} <= {*dir(ys)} and int(n_modules) < 100  # noqa: PT018
    assert done.stderr.splitlines()[-1].startswith("AttributeError: module 'rl_yardstick' has no")


def test_a_run_is_the_command_s(run, typed):
    words = "--env FrozenLake-v1 --algo qlearning -n 2000 --seed 0 -f there".split()  # noqa: SIM905
    typed.done("train.py", *words)
    other = ys.Run("there/qlearning/FrozenLake-v1_1")
    names = ("mean_return", "score", "optimum", "n_timesteps", "best_mean_return")
    assert [run.result[name] for name in names] == [other.result[name] for name in names]
    assert run.curve.equals(other.curve) and len(run.curve) == 20  # noqa: PT018
    assert (run.model.policy.q_table == other.model.policy.q_table).all()
    assert run.png == run._repr_png_() == (run.folder / "value_map.png").read_bytes()
    assert "data:image/png;base64," in run._repr_html_()


def test_findings_of_an_environment_by_name():
    found = ys.check_env(Line)
    assert {name: one.level for name, one in found.items()} == {"step-after-end": "note"}
    assert repr(ys.check_env("FrozenLake-v1", is_slippery=False)) == "nothing found"
    with pytest.raises(UserError, match="unknown argument 'size'"):
        ys.check_env("FrozenLake-v1", size=3)


def test_the_optimum_is_that_of_the_arguments():
    dry = ys.optimum(gym.make("FrozenLake-v1", is_slippery=False, max_episode_steps=50))
    assert (dry["optimum"], dry["horizon"], dry["values"][0]) == (1, 50, 1)
    assert dry["actions"].shape == (16, 4)
    assert ys.optimum("FrozenLake-v1", is_slippery=False, max_episode_steps=5)["optimum"] == 0
    # Five times -0.1 and once 0.5, which sum to 0 but for rounding.
    costly = {"reward_schedule": (0.5, -9, -0.1), "is_slippery": False, "max_episode_steps": 6}
    assert ys.optimum("FrozenLake-v1", **costly)["optimum"] == 0


def test_an_explanation_is_of_a_run_a_path_or_a_model(run):
    found = [ys.explain(one) for one in (run, run.folder, str(run.folder))]
    for each in (*found, ys.explain(run.model, "FrozenLake-v1")):
        assert each["return"] == run.result["mean_return"]
        assert each.lines == found[0].lines


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ys.train("FrozenLake-v1", "qlearnin"), "did you mean 'qlearning'?"),
        (lambda: ys.train("FrozenLake-v1", "qlearning", gama=1), "did you mean 'gamma'?"),
        (lambda: ys.train("FrozenLake-v1", "qlearning", seed=-3), "--seed: must be a whole number"),
        (lambda: ys.train(3), "an environment is an id, one object or a class, not 3"),
        (lambda: ys.train("CartPole-v1", Line()), "an agent is a name or a class, not <"),
        (lambda: ys.compare("FrozenLake-v1", [Learner] * 2), "test_api.Learner twice"),
        (lambda: ys.compare("FrozenLake-v1", "ppo", 0), "--seeds: must be a whole number"),
        (lambda: ys.compare("FrozenLake-v1", "ppo", n=1, sed=1), "no hyperparameter 'sed'"),
        (lambda: ys.explain(Line()), "needs its env"),
        (lambda: ys.optimum("CartPole-v1"), "the model of CartPole-v1 is not known"),
        (lambda: ys.Run("nowhere"), "nowhere is no run folder"),
        (lambda: ys.audit("ucb"), "it is for bandits"),
        (lambda: ys.train("FrozenLake-v1", "random", n=9, folder=__file__), ".py/random: Not a d"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(call, words, tmp_path):
    with pytest.raises(UserError) as error:
        call()
    assert words in str(error.value)
    assert error.value._render_traceback_() == [f"error: {error.value}"]
    assert list(tmp_path.iterdir()) == []


def test_settings_are_flags_and_hyperparameters():
    settings = {"n_timesteps": 500, "eval_freq": 100, "learning_rate": "lin_0.5", "gamma": 0.5}
    spec = spec_from_flags(api._flags(api.train_command, "FrozenLake-v1", "qlearning", settings))
    assert {**vars(spec), **spec.algorithm}.items() >= settings.items()
    words = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [4], "activation_fn": DQN}}
    args = api._flags(api.compare_command, "CartPole-v1", "dqn", words)
    assert args.policy == []
    named = "{'net_arch': [4], 'activation_fn': 'stable_baselines3.dqn.dqn.DQN'}"
    assert f"policy_kwargs:{named}" in args.hyperparams


def test_environments_without_an_id_get_one():
    made, wrapped = Line(), TransformReward(gym.make("FrozenLake-v1"), lambda reward: 2 * reward)
    for given in (Line, made, wrapped, lambda size=1: Line()):
        env_id, kwargs = api._environment(given)
        assert api._environment(given) == (env_id, kwargs) == (env_id, {})
        assert gym.make(env_id).unwrapped is not made
    dry = gym.make("FrozenLake-v1", is_slippery=False, render_mode="rgb_array")
    assert api._environment(dry) == ("FrozenLake-v1", {"is_slippery": False})
    short = gym.make("CliffWalking-v1", max_episode_steps=9)
    assert api._environment(short) == ("CliffWalking-v1", {"max_episode_steps": 9})
    assert api._environment(short, is_alone=False) == ("CliffWalkingEnv-v0", {})


def test_own_classes_are_named_and_their_code_belongs_to_the_study(monkeypatch):
    known = (DQN, agents.load_algorithm("sarsa"))
    assert [api._agent(one) for one in known] == ["dqn", "sarsa"]
    assert api._agent(Learner) == f"{Learner.__module__}.Learner"
    one = Line()
    ys.compare(one, "random", 1, n_timesteps=20, no_report=True)
    with pytest.raises(UserError, match=r"other settings \(n_timesteps: 20 there, 30 now"):
        ys.compare(one, "random", 1, n_timesteps=30, no_report=True)
    monkeypatch.setattr(Line, "step", lambda self, action: None)
    with pytest.raises(UserError, match=r"other settings \(code: .*by --name NAME"):
        ys.compare(one, "random", 1, n_timesteps=20, no_report=True)


# A script without a guard, as people write it: its classes are copied to two workers.
SCRIPT = """
import rl_yardstick as ys
from tests.test_api import Line
from rl_yardstick.agents.planning import RandomAgent

class Mine(Line): pass
class Chance(RandomAgent): pass
print("begun")
study = ys.compare(Mine, [Chance, "random"], 2, n_timesteps=20, jobs=2, no_report=True)
print(len(study.runs), *study.table["name"], study.page, *study.verdicts["verdict"])
print(study._repr_html_()[:5], ys.Study(study.folder).table.equals(study.table))
"""


def test_classes_of_a_script_train_in_parallel(tmp_path, typed):
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    printed = subprocess.check_output([sys.executable, "script.py"], env=environment, text=True)
    assert printed.count("begun") == 1
    assert "\n4 Chance random None " in printed
    assert printed.endswith("<pre> True\n")
    err = typed.refused("compare.py", "--resume", "logs/studies/Mine-v0_Chance-random")
    assert "the same call of compare there continues" in err


def test_an_interrupt_ends_at_a_safe_moment_and_leaves_no_handler(monkeypatch, capsys):
    def do_runs(runs, workers, command, console, stop):
        signal.raise_signal(signal.SIGINT)
        stop.check()

    def interrupted():
        ys.compare("FrozenLake-v1", "random", 1, n_timesteps=20)

    monkeypatch.setattr("rl_yardstick.experiments.pool.do_runs", do_runs)
    before = signal.getsignal(signal.SIGINT), vars(sys.modules["__main__"]).get("__file__")
    with pytest.raises(KeyboardInterrupt, match="stopped at a safe moment"):
        interrupted()
    after = signal.getsignal(signal.SIGINT), vars(sys.modules["__main__"]).get("__file__")
    assert before == after
    assert "stopped; continue with: the same call" in capsys.readouterr().out


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_have_the_outputs_that_they_show(path, tmp_path):
    shown, made = nbformat.read(path, 4), nbformat.read(path, 4)
    handler = signal.getsignal(signal.SIGINT)  # nbclient leaves one of its own
    NotebookClient(made, resources={"metadata": {"path": str(tmp_path)}}).execute()
    signal.signal(signal.SIGINT, handler)
    texts = [
        [output.data["text/plain"] for output in cell.get("outputs", ()) if "data" in output]
        for cell in (*shown.cells, *made.cells)
        if "Processor time" not in str(cell.get("outputs"))
    ]
    assert texts[: len(texts) // 2] == texts[len(texts) // 2 :]

"""`explain`, `audit` and `shaping` as a user types them: answers, files, refusals."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from rl_yardstick.pipeline.settings import read_entry
from rl_yardstick.report.documents import write_tables
from tests.pipeline.short_runs import LAKE, trained


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lake")
    entry = read_entry("qlearning", LAKE)
    trained("qlearning", LAKE, {**entry, "n_timesteps": 3000}, folder=folder, save_freq=1000)
    return folder


@pytest.fixture
def run(typed, logs, tmp_path):
    """A run of Q-learning that has not settled, with checkpoints."""
    shutil.copytree(logs, tmp_path / "logs")
    return "logs/qlearning/FrozenLake-v1_1"


def test_a_run_is_explained_in_twelve_lines_and_as_json(typed, run):
    out = typed.done("explain", run, "--json", "why.json")
    data = json.loads(Path("why.json").read_text())
    told, commands = out.split("to see what helps")
    assert len(told.splitlines()) <= 13  # which run, twelve lines
    assert f"gap {data['gap']:.4g}: it returns" in out
    assert sum(part["loss"] for part in data["parts"]) == pytest.approx(data["gap"])
    assert {"name", "loss", "visits", "action", "best", "updates"} <= data["states"][0].keys()
    zipped = typed("explain", f"{run}/FrozenLake-v1.zip", "--map", "costs.png")[1]
    assert zipped.split("to see what helps")[0].splitlines()[1:] == told.splitlines()[1:]
    assert zipped.endswith("\nmap: costs.png\n")
    to_copy = commands.replace("\\\n", "").split()
    assert f"explain {run} --json why.json --test" == " ".join(to_copy[-5:])
    assert Path("costs.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("in_this_process")
def test_a_change_is_tried_on_four_seeds_beside_the_run_as_it_is(typed, run):
    words = ("--test", "n_timesteps:60000", "--test", "gamma:0.5", "--json", "why.json")
    out = typed.done("explain", run, *words, "-j", 1)
    told = json.loads(Path("why.json").read_text())["tried"]
    tried = {one["change"]: one["returns"] for one in told}
    assert [*tried] == ["as shipped", "as it is", "n_timesteps:60000", "gamma:0.5"]
    assert {len(returns) for returns in tried.values()} == {4}
    assert "n_timesteps:60000 helps most" in out
    assert "16 runs, 16 of them there already" in typed("explain", run, *words)[1]


def test_of_a_study_the_median_run_of_a_pair_is_explained(typed, report_study, tmp_path):
    folder = tmp_path / "moved"
    shutil.copytree(report_study.root, folder)
    write_tables(replace(report_study.analysis.results, root=folder))
    pair = ("--algo", "Q-learning & co", "--env", "FrozenLake-v1")
    out = typed.done("explain", folder, *pair, "--json", "why.json")
    table = report_study.analysis.results.summary
    rows = table[(table["agent"] == pair[1]) & (table["environment"] == pair[3])]
    assert str(folder) in "".join(out.splitlines()[:2])
    assert json.loads(Path("why.json").read_text())["return"] == pytest.approx(rows["final"].min())
    said = "choose one by --env: FrozenLake-v1, Warehouse-v0"
    assert said in typed.refused("explain", folder, *pair[:2])


# Q-learning in which an episode that is cut off counts as ended.
SCRIPT = """
import numpy as np

def train(make_env, seed, gamma, steps):
    rng, env = np.random.default_rng(seed), make_env()
    q, obs = np.zeros((env.observation_space.n, 2)), env.reset(seed=seed)[0]
    for _ in range(steps):
        action = int(rng.integers(2)) if rng.random() < 0.5 else int(q[obs].argmax())
        following, reward, terminated, truncated, _ = env.step(action)
        done = terminated or truncated
        q[obs, action] += 0.1 * (reward + gamma * q[following].max() * (not done) - q[obs, action])
        obs = env.reset()[0] if done else following
    class Agent:
        act = staticmethod(lambda obs: int(q[obs].argmax()))
        values = staticmethod(lambda obs: q[obs])
    return Agent()
"""


def test_a_script_of_ones_own(typed, tmp_path):
    (tmp_path / "my_audited_script.py").write_text(SCRIPT)
    words = ("--script", "my_audited_script:train", "--seeds", "1", "--json", "out.json")
    code, out, err = typed("audit", *words)
    assert (code, err) == (1, "")
    assert out.startswith("target = 1.00 reward + 0.80 next value + 0.00 value where cut off; ")
    assert "\nfault: no-bootstrap-at-truncation\nnearest in tolerances: no-bootstrap-at-tr" in out
    found = json.loads((tmp_path / "out.json").read_text())
    assert (found["verdict"], found["fault"]) == ("fault", "no-bootstrap-at-truncation")
    assert abs(found["measured"]["where_cut"]) < 0.01


RETURN = "optimal policies return"


@pytest.fixture
def shape(typed, monkeypatch):
    """Type the command: its lines, unbroken, and what it writes."""
    monkeypatch.setattr("rl_yardstick.commands.terminal.wrapped", str)

    def run(*words):
        out = typed.done("shaping", *words, "--json", "s.json")
        return out.splitlines(), json.loads(Path("s.json").read_text())

    return run


def test_the_shipped_changes_of_warehouses_cost_nothing(shape):
    lines, data = shape("--env", "Warehouse-v0", "--algo", "ppo")
    told = "random starts, episodes of 100 steps, rewards clipped at -10, rewards x 0.01"
    assert lines[0].endswith(told)
    assert lines[1:3] == [
        "discount 0.9995: the same policies are optimal",
        f"  with the changes {RETURN} 79; the optimum is 79: the changes cost nothing",
    ]
    assert [one["same"] for one in data["objectives"]] == [True, True]
    assert [one["discount"] for one in data["objectives"]] == [0.9995, 1.0]
    assert data["objectives"][0]["factor"] is None  # clipping is no potential


def test_rewards_that_make_another_policy_optimal(shape):
    words = ("-params", "gamma:0.9", "--train-env-kwargs", "reward_schedule:[1,-1,-0.5]")
    lines, data = shape("--env", "FrozenLake-v1", *words)
    assert lines[1].startswith("discount 0.9: NOT the same policies are optimal: the best actions")
    gains = [place["gain"] for place in data["objectives"][0]["states"]]
    assert sum(gains) == pytest.approx(0.6971, abs=5e-5)
    assert lines[2].startswith("  row 1, column 1: best is left, with the changes down or right; ")
    assert lines[3].endswith("; the optimum is 0.74419: the changes cost 0.6971")


def test_wrappers_in_order_and_the_agents_own_discount(shape):
    wrappers = ("--wrapper", "gymnasium.wrappers.ClipReward", "min_reward:-1")
    wrappers += ("--wrapper", "rl_yardstick.envs.wrappers.ScaleReward", "scale:3")
    lines, data = shape("--env", "CliffWalking-v1", "--algo", "qlearning", *wrappers)
    assert lines[0] == "CliffWalking-v1; changed in training: rewards clipped at -1, rewards x 3"
    # It does not discount. The cliff is as cheap as any step then, but leads back to the start.
    assert [(one["discount"], one["same"]) for one in data["objectives"]] == [(1, True)]
    assert data["optimum"] == -13

"""``shaping`` as a user types it: settings of agents, arguments, wrappers, refusals."""

import json
from pathlib import Path

import pytest

RETURN = "optimal policies return"

# A world of the user's whose rewards may be shaped by a potential: how far a walker has come.
WALK = """
import gymnasium as gym
import numpy as np


class Walk(gym.Env):
    def __init__(self, scale=0.0, gamma=0.9, loop=0.0):
        self.observation_space = gym.spaces.Discrete(4)
        self.action_space = gym.spaces.Discrete(2)
        self.initial_state_distrib = np.array([1.0, 0.0, 0.0, 0.0])
        potential = [0.0, scale, 2 * scale, 3 * scale]
        self.P = {}
        for s in range(4):
            self.P[s] = {}
            for a, after in enumerate((max(s - 1, 0), s + 1)):
                ends = after == 4
                reward = (10.0 if ends else -1.0) - potential[s]
                reward += (0.0 if ends else gamma * potential[after]) + loop * (after == s + 1)
                self.P[s][a] = [(1.0, min(after, 3), reward, ends)]

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 0
        return 0, {}

    def step(self, action):
        _, self.s, reward, ends = self.P[self.s][int(action)][0]
        return self.s, reward, ends, False, {}


gym.register("Walk-v0", entry_point=f"{__name__}:Walk", max_episode_steps=20)
"""


@pytest.fixture
def shape(type_command, tmp_path):
    """Type the command: its lines, and what it writes."""
    (tmp_path / "walk.py").write_text(WALK)

    def run(*words):
        code, out, err = type_command("shaping", *words, "--json", "s.json")
        assert (code, err) == (0, "")
        return out.splitlines(), json.loads(Path("s.json").read_text())

    return run


def test_the_shipped_changes_of_warehouses_cost_nothing(shape):
    lines, data = shape("--env", "Warehouse-v0", "--algo", "ppo")
    assert lines[0].endswith(
        "random starts, episodes of 100 steps, rewards clipped at -10, rewards x 0.01"
    )
    assert lines[1:3] == [
        "discount 0.9995: the same policies are optimal",
        f"  with the changes {RETURN} 79; the optimum is 79: the changes cost nothing",
    ]
    assert [one["same"] for one in data["objectives"]] == [True, True]
    assert [one["discount"] for one in data["objectives"]] == [0.9995, 1.0]
    assert data["objectives"][0]["factor"] is None  # clipping is no potential


def test_a_potential_costs_nothing_and_a_bonus_for_every_step_forward_costs_all(shape):
    walk = ("--gym-packages", "walk.py", "--env", "Walk-v0", "-params")
    lines, data = shape(*walk, "gamma:0.9", "--train-env-kwargs", "scale:5")
    assert lines[1] == "discount 0.9: the same policies are optimal"
    assert lines[-1] == (
        "the changed rewards are the original ones plus the difference of a potential, "
        "which goes from 0 to 15"
    )
    first = data["objectives"][0]
    assert (first["factor"], first["cost"]) == (1, pytest.approx([0, 0], abs=1e-9))
    assert first["potential"] == pytest.approx([0, 5, 10, 15])
    lines, data = shape(*walk, "gamma:0.99", "--train-env-kwargs", "loop:10")
    # The optimum goes straight on, for -1 -1 -1 +10; to and fro costs 1 in each of 20 steps.
    assert lines[1].startswith("discount 0.99: NOT the same policies are optimal: the best actions")
    places = data["objectives"][0]["states"]
    assert sum(place["gain"] for place in places) == pytest.approx(27)
    assert lines[2].startswith(
        f"  {places[0]['state']}: best is action 1, with the changes action 0"
    )
    told = f"  with the changes {RETURN} -20; the optimum is 7: the changes cost 27"
    assert told in lines


def test_wrappers_in_order_and_the_agents_own_discount(shape):
    wrappers = ("--wrapper", "gymnasium.wrappers.ClipReward", "min_reward:-1")
    wrappers += ("--wrapper", "rl_yardstick.envs.wrappers.ScaleReward", "scale:3")
    lines, data = shape("--env", "CliffWalking-v1", "--algo", "qlearning", *wrappers)
    assert lines[0] == "CliffWalking-v1; changed in training: rewards clipped at -1, rewards x 3"
    # It does not discount. The cliff is as cheap as any step then, but leads back to the start.
    assert [(one["discount"], one["same"]) for one in data["objectives"]] == [(1, True)]
    assert data["optimum"] == -13


REFUSED = {
    "--env CartPole-v1": "the model of CartPole-v1 is not known",
    "--env Warehouse-v0 --wrapper rl_yardstick.envs.wrappers.ScaleReward scal:2": "scal",
    "--env FrozenLake-v1 -params normalize:true": "normalize: the rewards that it makes",
    "--env FrozenLake-v1 --train-env-kwargs map_name:8x8": (
        "64 states and 4 actions cannot be compared with 16 states and 4 actions"
    ),
}


def test_what_has_no_model_is_refused_in_one_line(type_command):
    for words, said in REFUSED.items():
        code, _, err = type_command("shaping", *words.split())
        assert (code, err.count("\n")) == (2, 1)
        assert said in err

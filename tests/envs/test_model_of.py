"""The models that `model_of` finds, against published models and figures known by other means."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import rl_yardstick.envs
from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.envs.model_of import FoundModel, model_of
from rl_yardstick.mdp.finite_horizon import finite_horizon_optimum
from rl_yardstick.mdp.transition_model import TransitionModel

rl_yardstick.envs.register_environments()
PATIENT = {"seconds": 100.0}


def optimum(found: FoundModel, horizon: int | None = None) -> float:
    steps = min(x for x in (horizon, found.horizon) if x is not None)
    return float(finite_horizon_optimum(found.model, steps, mask=found.mask).start_value)


def rows(model: TransitionModel, names: list[Any]) -> dict[Any, dict[Any, float]]:
    """{(state, action): {(next state, reward, variance, terminated): probability}}, by names."""
    table: dict[Any, dict[Any, float]] = {}
    noise = np.zeros_like(model.prob) if model.reward_variance is None else model.reward_variance
    for state in np.flatnonzero(model.reachable):
        for action in range(model.n_actions):
            row = table.setdefault((names[state], action), {})
            for k in np.flatnonzero(model.prob[state, action] > 0):
                at = state, action, k
                ends = bool(model.terminated[at])
                to = None if ends else names[model.next_state[at]]
                key = to, round(float(model.reward[at]), 9), round(float(noise[at]), 9), ends
                row[key] = row.get(key, 0.0) + float(model.prob[at])
    return table


def name_of(observation: Any) -> Any:
    if isinstance(observation, dict):
        return tuple(name_of(part) for part in observation.values())
    return tuple(np.ravel(observation).tolist())


def same_model(found: FoundModel, published: TransitionModel, observations: Any) -> None:
    """Equal to 1e-9, with states matched by what they show."""
    own = rows(found.model, [name_of(o) for o in found.observations])
    other = rows(published, [name_of(o) for o in observations])
    assert own.keys() == other.keys()
    for pair, row in own.items():
        assert row == pytest.approx(other[pair], abs=1e-9), pair
    starts = [{}, {}]
    for start, model, shown in (
        (starts[0], found.model, found.observations),
        (starts[1], published, observations),
    ):
        for state in np.flatnonzero(model.initial > 1e-12):
            start[name_of(shown[state])] = float(model.initial[state])
    assert starts[0] == pytest.approx(starts[1], abs=1e-9)


TOY_TEXT = {
    ("FrozenLake-v1",): (11, 0.744193),
    ("FrozenLake8x8-v1",): (53, 0.913218),
    ("CliffWalking-v1",): (37, -13.0),
    ("CliffWalking-v1", "is_slippery"): (37, -64.709),
    ("Taxi-v4",): (400, 7.93),
    ("Taxi-v4", "is_rainy"): (400, 3.9546),
}


@pytest.mark.parametrize("name", TOY_TEXT, ids="-".join)
def test_toy_text(name: tuple[str, ...]) -> None:
    states, best = TOY_TEXT[name]
    env = gym.make(name[0], **dict.fromkeys(name[1:], True))
    found = model_of(env, **PATIENT)
    assert len(found.observations) == states
    limit = env.spec.max_episode_steps or 1000
    assert optimum(found, limit) == pytest.approx(best, abs=1e-3)
    same_model(found, transition_model(env), range(env.observation_space.n))


def test_a_hidden_state_is_found() -> None:
    """Taxi's published model leaves out the passenger who changes their mind."""
    found = model_of(gym.make("Taxi-v4", fickle_passenger=True), **PATIENT)
    assert optimum(found, 200) == pytest.approx(8.38, abs=5e-3)
    assert found.notes == ["712 states stand behind 400 observations"]


class Tutorial(gym.Env):
    """A grid of the shape that Gymnasium's tutorial has: two places in a dictionary."""

    def __init__(self, size: int = 5) -> None:
        self.size = size
        self.agent = self.target = np.array([-1, -1])
        box = spaces.Box(0, size - 1, (2,), int)
        self.observation_space = spaces.Dict({"agent": box, "target": box})
        self.action_space = spaces.Discrete(4)
        self.moves = {0: np.array([1, 0]), 1: np.array([0, 1])}
        self.moves |= {2: np.array([-1, 0]), 3: np.array([0, -1])}

    def show(self) -> Any:
        return {"agent": self.agent, "target": self.target}, {
            "distance": np.linalg.norm(self.agent - self.target, ord=1)
        }

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.agent = self.np_random.integers(0, self.size, size=2, dtype=int)
        self.target = self.agent
        while np.array_equal(self.target, self.agent):
            self.target = self.np_random.integers(0, self.size, size=2, dtype=int)
        return self.show()

    def step(self, action: int) -> Any:
        self.agent = np.clip(self.agent + self.moves[action], 0, self.size - 1)
        over = np.array_equal(self.agent, self.target)
        observation, info = self.show()
        return observation, 1 if over else -0.01, over, False, info


def test_the_grid_of_the_tutorial() -> None:
    """Its loop draws a target until it is another place than the agent's."""
    found = model_of(Tutorial(5), **PATIENT)
    assert found.model.prob.shape == (600, 4, 1)
    assert np.ptp(found.model.initial) < 1e-15
    # The mean distance of two different places is 10/3: one step earns 1, the others -0.01.
    assert optimum(found, 1000) == pytest.approx(1 - 0.01 * (10 / 3 - 1), abs=1e-12)


class TicTacToe(gym.Env):
    """Against a random player; squares that are taken raise an error."""

    LINES = ((0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6))

    def __init__(self) -> None:
        self.observation_space = spaces.MultiDiscrete([3] * 9)
        self.action_space = spaces.Discrete(9)
        self.board = np.zeros(9, int)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.board[:] = 0
        return self.board, {}

    def put(self, square: int, player: int) -> bool:
        self.board[square] = player
        return any(all(self.board[i] == player for i in line) for line in self.LINES)

    def step(self, action: int) -> Any:
        if self.board[action]:
            raise ValueError("that square is taken")
        if self.put(action, 1):
            return self.board, 1.0, True, False, {}
        if not (free := [i for i in range(9) if not self.board[i]]):
            return self.board, 0.0, True, False, {}
        lost = self.put(self.np_random.choice(free), 2)
        return self.board, -1.0 * lost, lost, False, {}


def test_tic_tac_toe() -> None:
    found = model_of(TicTacToe(), **PATIENT)
    assert found.model.n_states == 2423
    assert optimum(found, 9) == pytest.approx(0.9947917, abs=1e-7)
    assert "not allowed: ValueError: that square is taken" in found.notes[0]

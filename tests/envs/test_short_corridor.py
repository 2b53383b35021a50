"""The short corridor against example 13.1 and its closed form."""

import gymnasium as gym
import numpy as np
import pytest

import envs  # noqa: F401 (registers the environments)
from agents import load_algorithm
from envs.known_models import model_check, observations_of_states, transition_model
from envs.textbook.short_corridor import ShortCorridorEnv
from mdp import finite_horizon_optimum, policy_return

LEFT, RIGHT = 0, 1


def steps_needed(p: float) -> float:
    """The solution of v1 = 1 + p v2 + (1-p) v1, v2 = 1 + p v1 + (1-p) v3, v3 = 1 + (1-p) v2."""
    return (4 - 2 * p) / (p * (1 - p))


@pytest.mark.parametrize("p", [0.05, 0.3, 0.5, 0.59, 0.95])
def test_returns_are_those_of_the_closed_form(p: float) -> None:
    model = transition_model(gym.make("ShortCorridor-v0"))
    assert model is not None
    found = policy_return(model, np.tile([1 - p, p], (4, 1)), 20_000).expected_return
    assert found == pytest.approx(-steps_needed(p), rel=1e-9)


def test_the_best_probability_is_that_of_the_book() -> None:
    grid = np.linspace(0.01, 0.99, 9801)
    best = grid[np.argmin(steps_needed(grid))]
    assert best == pytest.approx(2 - np.sqrt(2), abs=1e-4)
    assert round(best, 2) == 0.59
    assert steps_needed(best) == pytest.approx(11.66, abs=0.005)
    assert (round(steps_needed(0.05)), round(steps_needed(0.95))) == (82, 44)


def test_who_sees_the_states_needs_three_steps_and_who_does_not_plans_in_vain() -> None:
    env = gym.make("ShortCorridor-v0")
    model = transition_model(env)
    assert model is not None
    assert finite_horizon_optimum(model, 1000).start_value == -3
    for action in (LEFT, RIGHT):
        assert policy_return(model, np.full(4, action), 1000).expected_return == -1000
    with pytest.raises(ValueError, match="needs observations that tell the states apart"):
        load_algorithm("optimal")(env=env, seed=0).plan()


def test_actions_are_reversed_in_the_second_state_alone() -> None:
    env = ShortCorridorEnv()
    seen, _ = env.reset(seed=0)
    states = []
    for action in (LEFT, RIGHT, RIGHT, RIGHT, LEFT, LEFT, RIGHT, LEFT, RIGHT):
        obs, reward, terminated, _, _ = env.step(action)
        states.append(env.s)
        assert (obs, reward) == (0, -1.0)
    assert (seen, states, terminated) == (0, [0, 1, 0, 1, 2, 1, 0, 0, 1], False)
    env.step(LEFT)
    assert env.step(RIGHT)[:3] == (0, -1.0, True)
    assert env.observation_space.contains(obs)
    assert observations_of_states(env).tolist() == [0, 0, 0, 0]


def test_a_copy_of_ones_own_is_held_against_its_step() -> None:
    class Mine(ShortCorridorEnv):
        """Somebody else's, so that its word is not enough."""

    check = model_check(Mine())
    assert (check.refusal, check.n_steps > 0) == (None, True)

    class Telltale(ShortCorridorEnv):
        """One that shows more in its steps than it says."""

        def step(self, action: int):
            _, *rest = super().step(action)
            return (self.s, *rest)

    assert "was observed as 1, not 0" in model_check(Telltale()).refusal

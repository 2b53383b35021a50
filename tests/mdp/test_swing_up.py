"""Ways up and energies of a double pendulum, against Gymnasium's own."""

import gymnasium as gym
import numpy as np
import pytest

from mdp.double_pendulum import Swing, after_torques, energy
from mdp.swing_up import ENERGY_OF_BEING_UP, fewest_steps, greatest_energies, way_up


def test_it_moves_as_gymnasiums_does():
    env = gym.make("Acrobot-v1").unwrapped
    env.reset(seed=1)
    actions = np.random.default_rng(1).integers(0, 3, 200)
    states = after_torques(np.array(env.state, np.float64), actions - 1.0)
    for action, state in zip(actions, states, strict=True):
        env.step(int(action))
        assert np.abs(env.state - state).max() < 1e-9


def test_a_way_up_leads_up_in_gymnasium():
    env = gym.make("Acrobot-v1").unwrapped
    env.reset(seed=2)
    way = way_up(np.array(env.state, np.float64), 100, 500)
    ends = [env.step(int(torque))[2] for torque in way]
    assert ends == [False] * (len(way) - 1) + [True]
    assert len(way) < 80


def test_no_way_is_where_there_are_too_few_steps():
    assert len(way_up(np.zeros(4), 20, 10)) == 0


def test_energy_is_kept_without_torque():
    states = after_torques(np.array([0.5, -0.3, 0.2, 0.4]), np.zeros(20))
    energies = [energy(Swing(*state)) for state in states]
    assert np.ptp(energies) < 1e-2 * energies[0]


def test_being_up_takes_so_much_energy():
    rng = np.random.default_rng(0)
    first, second = rng.uniform(-np.pi, np.pi, (2, 20_000))
    is_up = -np.cos(first) - np.cos(first + second) > 1
    places = zip(first[is_up], second[is_up], strict=True)
    least = min(energy(Swing(*angles, 0.0, 0.0)) for angles in places)
    assert ENERGY_OF_BEING_UP <= least < ENERGY_OF_BEING_UP + 0.2


def test_no_sequence_of_torques_brings_more_than_the_greatest_energy():
    greatest = greatest_energies(5.0, 4, 24)
    assert greatest[0] == pytest.approx(5.0)
    rng = np.random.default_rng(0)
    for _ in range(300):
        angles, direction = rng.uniform(-np.pi, np.pi, 2), rng.uniform(0, 2 * np.pi)
        still = energy(Swing(*angles, 0.0, 0.0))
        if still > 5:
            continue
        unit = np.array([np.cos(direction), np.sin(direction)])
        size = np.sqrt((5 - still) / (energy(Swing(*angles, *unit)) - still))
        torques = rng.choice([-1.0, 0.0, 1.0], 4)
        states = after_torques(np.array([*angles, *(size * unit)]), torques)
        for step, state in enumerate(states, start=1):
            assert energy(Swing(*state)) - 5 <= 1.05 * (greatest[step] - 5)


def test_fewest_steps_take_the_best_of_long_and_short_looks():
    """Two at a step, but three in two and five in three steps."""
    levels = np.array([0.0, 100.0])
    greatest = levels[:, None] + np.array([0.0, 2.0, 3.0, 5.0])
    # After six steps 9 is one more than three times three, by two looks of three steps less one.
    assert [fewest_steps(levels, greatest, 0.0, goal) for goal in (2, 2.1, 3, 5, 6, 6.1, 9)] == [
        *(1, 2, 2, 3, 4, 5, 6)
    ]

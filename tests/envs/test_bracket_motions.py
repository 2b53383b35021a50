"""The motions from which `benchmarks/optimum_brackets.py` works out brackets.

Costs by cells are below what anything reaches, and come near it; and the ways up and the energies
of a double pendulum are held against Gymnasium's own.
"""

import math
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import train

sys.path.append(str(Path(train.__file__).parent / "benchmarks"))

from _double_pendulum import (
    ENERGY_OF_BEING_UP,
    Swing,
    after_torques,
    energy,
    fewest_steps,
    greatest_energies,
    way_up,
)
from _pushed_motion import (
    MOTIONS,
    best_action,
    cells_of,
    interpolated,
    interpolated_costs,
    mean_cost,
    moved,
    optimistic_costs,
    push_costs,
    rounded_down,
)

# A sled on ice: no pull, from -1 to the goal at 1, a thousandth faster in each step at most.
SLED = MOTIONS["MountainCar-v0"]._replace(low=-1.0, high=1.0, pull_size=0.0)


def steps_of_a_sled(distance):
    """The least n with 0.001 (1 + 2 + ... + n), at 0.07 at most, not below a distance."""
    steps, done = 0, 0.0
    while done < distance - 1e-12:
        steps += 1
        done += min(0.001 * steps, 0.07)
    return steps


def test_a_sled_takes_as_many_steps_as_worked_out():
    cells = cells_of(SLED, 1000, 1401)
    costs = optimistic_costs(SLED, cells)
    for start in (-0.499, -0.1, 0.35, 0.95):
        least = mean_cost(SLED, cells, costs, (start, start + 1e-4), (0.0, 0.0))
        exact = steps_of_a_sled(1 - start)
        assert exact * 0.93 - 1 <= least <= exact


def test_wind_that_is_stronger_than_the_engine_blows_at_the_greatest_speed():
    windy = SLED._replace(pull_size=0.005, pull_rate=0.0)
    cells = cells_of(windy, 400, 141)
    costs = optimistic_costs(windy, cells)
    # From -0.39 to 1 it takes twenty steps of 0.07; from the best place in each cell nineteen.
    assert costs[cells.positions.searchsorted(-0.39) - 1, -1] == pytest.approx(19.5, abs=0.51)


def test_the_last_step_costs_what_the_nearest_state_of_a_cell_does():
    motion = MOTIONS["Pendulum-v1"]._replace(horizon=1)
    cells = cells_of(motion, 20, 16)
    costs = optimistic_costs(motion, cells)
    for column, row in ((0, 0), (9, 8), (10, 7), (15, 3), (19, 15)):
        x = min(abs(cells.positions[column] + near) for near in (0, cells.width))
        v = min(abs(cells.speeds[row] + near) for near in (0, cells.height))
        assert costs[column, row] == pytest.approx(x**2 + 0.1 * v**2, abs=1e-5)
        assert costs[column, row] <= x**2 + 0.1 * v**2


def test_a_planned_sled_takes_hardly_a_step_more_than_it_has_to():
    plan = interpolated_costs(SLED, 200, 101, SLED.actions)
    position, speed, n_steps = -0.1, 0.0, 0
    while position < SLED.high:
        n_steps += 1
        action, _ = best_action(SLED, SLED.actions, plan[SLED.horizon - n_steps], position, speed)
        position, speed = moved(SLED, position, speed, action)
    assert n_steps <= steps_of_a_sled(1.1) + 1


def test_finer_cells_bound_more_closely():
    motion = MOTIONS["MountainCar-v0"]
    bounds = []
    for n in (200, 400, 800):
        cells = cells_of(motion, n, n + 1)
        costs = optimistic_costs(motion, cells)
        bounds.append(mean_cost(motion, cells, costs, (-0.6, -0.4), (0.0, 0.0)))
    assert bounds == sorted(bounds)
    assert bounds[-1] > bounds[0] + 5


@pytest.mark.parametrize("name", MOTIONS)
def test_no_way_costs_less_than_its_cells_say(name):
    """Ways at random, and those of a plan: what remains of their cost, at each state on them."""
    motion = MOTIONS[name]._replace(horizon=60, final_cost=0.0)
    cells = cells_of(motion, 150, 151)
    costs, rng = optimistic_costs(motion, cells), np.random.default_rng(0)
    plan = interpolated_costs(motion, 40, 41, motion.actions)
    for trial in range(60):
        states, paid = _way(motion, plan if trial % 2 else None, rng)
        remaining = np.cumsum(paid[::-1])[::-1]
        # The bound of a state with the whole limit ahead: of the first alone.
        column, row = _cell(motion, cells, *states[0])
        assert costs[column, row] <= remaining[0] + 1e-9


def _way(motion, plan, rng):
    position = rng.uniform(motion.low, motion.high)
    speed = rng.uniform(-motion.most_speed, motion.most_speed)
    states, paid = [(position, speed)], []
    for left in range(motion.horizon)[::-1]:
        own = motion.position_cost * position**2 + motion.speed_cost * speed**2
        if plan is None:
            action = rng.uniform(*motion.actions[[0, -1]])
            action = action if motion.is_continuous else round(action)
        else:
            action, _ = best_action(motion, motion.actions, plan[left], position, speed)
        paid.append(motion.step_cost + own + motion.action_cost * action**2)
        position, speed = moved(motion, position, speed, action)
        states.append((position, speed))
        if position >= motion.high:
            break
    return states, paid


def _cell(motion, cells, position, speed):
    column = int((position - motion.low) / cells.width)
    row = int((speed + motion.most_speed) / cells.height)
    return min(column, len(cells.positions) - 1), min(row, len(cells.speeds) - 1)


def test_rows_that_an_action_leads_into():
    """Without pull, and rows of half a push: an action of 1 leads one to three rows further."""
    motion = SLED._replace(most_speed=0.01, action_cost=2.0, rounding=1e-12)
    first, costs = push_costs(motion, cells_of(motion, 3, 40))
    assert (first == -3).all()
    # A row further is within reach of no action too.
    assert costs[1].tolist() == [2.0, 2.0, 0.0, 0.0, 0.0, 2.0, 2.0]


def test_no_number_is_rounded_up():
    values = np.array([0.1, 1 / 3, 1e10 / 7, 2.0, np.inf])
    singles = rounded_down(values)
    assert (singles <= values).all()
    assert singles[3:].tolist() == [2.0, np.inf]
    assert np.allclose(singles[:3], values[:3], rtol=2e-7)


def test_between_nodes_costs_are_linear():
    nodes = np.array([[0.0, 1.0, 2.0], [10.0, 11.0, 12.0]], np.float32)
    motion = SLED
    assert interpolated(motion, nodes, -1.0, -0.07) == 0.0
    assert interpolated(motion, nodes, 0.0, 0.035) == pytest.approx(5 + 1.5)
    assert interpolated(motion, nodes, 1.0, 0.0) == 0.0, "the goal"


def test_a_circle_wraps_and_a_wall_stops():
    pendulum, car = MOTIONS["Pendulum-v1"], MOTIONS["MountainCar-v0"]
    position, speed = moved(pendulum, 3.1, 7.0, 0.0)
    assert position == pytest.approx(3.1 + 0.05 * (7 + 0.75 * math.sin(3.1)) - 2 * math.pi)
    assert speed == pytest.approx(7 + 0.75 * math.sin(3.1))
    assert moved(car, -1.19, -0.05, 0.0) == (-1.2, 0.0)


@pytest.mark.parametrize("name", MOTIONS)
def test_motions_are_those_of_gymnasium(name):
    """From states in the whole range, at walls and the greatest speed too."""
    motion, env, rng = MOTIONS[name], gym.make(name).unwrapped, np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(300):
        position = rng.uniform(motion.low, motion.high)
        speed = motion.most_speed * rng.uniform(-1, 1)
        action = rng.choice(motion.actions)
        env.state = np.array([position, speed])
        given = np.array([action], np.float32) if motion.is_continuous else int(action) + 1
        _, reward, terminated, _, _ = env.step(given)
        expected = moved(motion, position, speed, action)
        apart = np.abs(np.array(env.state) - expected)
        if motion.is_circle:
            apart[0] = abs((apart[0] + np.pi) % (2 * np.pi) - np.pi)
        assert (apart <= max(motion.rounding, 1e-9) + 1e-7 * motion.is_continuous).all()
        cost = motion.step_cost + motion.action_cost * action**2
        cost += motion.position_cost * position**2 + motion.speed_cost * speed**2
        assert terminated == (expected[0] >= motion.high)
        gained = 100.0 if terminated and motion.final_cost else 0.0
        assert reward == pytest.approx(gained - cost, abs=1e-5)


# --- the double pendulum -------------------------------------------------------------------------


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

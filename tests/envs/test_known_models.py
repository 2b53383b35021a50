"""What is known exactly about environments: the model, step for step; what brackets the optimum."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import MountainCarEnv
from gymnasium.utils.seeding import np_random
from stable_baselines3.common.monitor import Monitor

import train
from rl_yardstick.envs import brackets, wrappers
from rl_yardstick.envs import known_models as known
from rl_yardstick.envs.layout import action_names, grid_layout, state_name
from rl_yardstick.mdp import finite_horizon_optimum

EIGHT = {"map_name": "8x8", "success_rate": 0.6, "reward_schedule": (3, -2, -0.1)}
WORLDS = {
    "Warehouse": ("Warehouse-v0", {}),
    "slippery Warehouse": ("Warehouse-v0", {"slip": 0.3, "random_start": True, "shelf_reward": -1}),
    "one-hot Warehouse": ("Warehouse-v0", {"slip": 0.1, "observation": "one_hot"}),
    "MineMaze": ("MineMaze-v0", {}),
    "slippery MineMaze": ("MineMaze-v0", {"slip": 0.4, "random_start": True, "power_reward": 0}),
    "FrozenLake": ("FrozenLake-v1", {}),
    "still FrozenLake": ("FrozenLake-v1", {"is_slippery": False}),
    "FrozenLake 8x8": ("FrozenLake-v1", EIGHT),
    "CliffWalking": ("CliffWalking-v1", {}),
    "Taxi": ("Taxi-v4", {}),
    "DynaMaze": ("DynaMaze-v0", {"maze": "shortcut", "changed": True}),
    "RandomWalk": ("RandomWalk-v0", {"n_states": 1000, "max_jump": 100, "left_reward": -1}),
    "Hallway": ("Hallway-v0", {}),
    "DarkWarehouse": ("DarkWarehouse-v0", {"slip": 0.1}),
    "BernoulliBandit": ("BernoulliBandit-v0", {"pulls": 90}),
    "SegmentBandit": ("SegmentBandit-v0", {"batch_size": 9, "pulls": 90}),
}


def make(name):
    env_id, kwargs = WORLDS[name]
    return gym.make(env_id, **kwargs)


def first_above(probabilities, uniform):
    return int(np.argmax(np.cumsum(probabilities) > uniform))


def assert_replays(env, steps=500):
    """Predict every start and step from the model and a generator of the same seed."""
    model, observations = known.transition_model(env), known.observations_of_states(env)
    uniform = np_random(3)[0].random
    obs, state = env.reset(seed=3)[0], first_above(model.initial, uniform())
    np.testing.assert_array_equal(obs, observations[state])
    for action in np.random.default_rng(5).integers(model.n_actions, size=steps).tolist():
        outcome = state, action, first_above(model.prob[state, action], uniform())
        obs, reward, terminated, truncated, _ = env.step(action)
        state = model.next_state[outcome]
        assert (env.unwrapped.s, reward) == (state, model.reward[outcome])
        assert terminated == model.terminated[outcome]
        np.testing.assert_array_equal(obs, observations[state])
        assert env.observation_space.contains(obs)
        if terminated or truncated:
            obs, _ = env.reset()
            state = first_above(model.initial, uniform())
            np.testing.assert_array_equal(obs, observations[state])
    assert env.np_random.random() == uniform()


@pytest.mark.parametrize("name", WORLDS)
def test_the_model_replays_the_environment(name):
    assert_replays(make(name))


def test_what_wrappers_do_to_rewards_is_folded_in():
    lake = make("FrozenLake 8x8")
    scaled = wrappers.ScaleReward(Monitor(lake), 0.1)
    replaced = wrappers.TerminationReward(scaled, reward=-0.7)
    counted = gym.wrappers.RecordEpisodeStatistics(replaced, stats_key="stats")
    assert_replays(wrappers.ScaleReward(counted, -3.0), steps=300)
    assert_replays(wrappers.ScaleReward(gym.wrappers.ClipReward(scaled, -0.5, 0.3), 0.7), steps=300)
    assert_replays(gym.wrappers.ClipReward(lake, 0.1, None), steps=300)


def test_what_wrappers_do_to_observations_is_folded_in():
    lake, position = make("FrozenLake"), gym.make("Warehouse-v0", observation="position")
    assert_replays(wrappers.OneHotObservation(wrappers.FlattenToDiscrete(lake)), steps=200)
    assert_replays(wrappers.DiscretizeObservation(position, bins=4), steps=200)
    seen = known.observations_of_states(wrappers.OneHotObservation(lake))
    assert seen.tolist() == np.eye(16).tolist()
    # Where it is not known what is seen, the model is known all the same.
    assert known.observations_of_states(gym.wrappers.TimeAwareObservation(lake)) is None


def test_what_wrappers_make_of_drawn_rewards():
    env = gym.make("MaximizationBias-v0", reward_std=2)
    assert known.transition_model(wrappers.ScaleReward(env, 3)).reward_variance[1, 0, 0] == 36
    assert not known.transition_model(wrappers.TerminationReward(env, -5)).reward_variance.any()
    assert known.transition_model(gym.wrappers.ClipReward(env, -1, 1)) is None


class Anything(gym.Wrapper):
    """A wrapper of somebody else's."""


SEARCHED = {
    "function": lambda: gym.wrappers.TransformReward(make("FrozenLake"), lambda reward: reward),
    "inside": lambda: Monitor(Anything(make("FrozenLake"))),
    "on_truncation": lambda: wrappers.TerminationReward(
        make("FrozenLake"), 5, on_truncation=True),
}  # fmt: skip


@pytest.mark.parametrize("what", SEARCHED)
def test_around_what_is_not_known_a_search_finds_the_same(what):
    env, plain = SEARCHED[what](), make("FrozenLake")
    models = [known.transition_model(each) for each in (env, plain)]
    found, best = (finite_horizon_optimum(each, 100).start_value for each in models)
    # Every episode ends with the reward of 5, by a termination or by time.
    assert found == pytest.approx(5.0 if what == "on_truncation" else best, abs=1e-9)
    assert known.found_model(plain) is None


UNKNOWN = {
    "CartPole": lambda: gym.make("CartPole-v1"),
    "Gaussian": lambda: gym.make("GaussianBandit-v0"),
    "changing": lambda: gym.make(
        "DynaMaze-v0", maze="blocking", changed=True, change_after_steps=9),
}  # fmt: skip


@pytest.mark.parametrize("what", UNKNOWN)
def test_nothing_is_told_where_the_model_is_not_known(what):
    env = UNKNOWN[what]()
    tellers = known.transition_model, known.success_outcomes, known.observations_of_states
    assert [teller(env) for teller in tellers] == [None] * 3


def test_time_limits_and_models_that_are_none():
    for env_id, limit in (("MineMaze-v0", 100), ("CliffWalking-v1", None)):
        env = gym.make(env_id)
        assert known.time_limit(env) == limit
        assert known.time_limit(Monitor(gym.wrappers.TimeLimit(env, 5000))) == (limit or 5000)
        assert known.time_limit(gym.wrappers.TimeLimit(wrappers.ScaleReward(env, 0.5), 7)) == 7
    env = make("FrozenLake")
    env.unwrapped.P[3][1] = [(0.5, 0, 0.0, False)]
    assert known.transition_model(env) is None
    line = "state 3, action 1 has probabilities that do not sum to one"
    assert known.model_check(env).refusal == f"the environment's P is no model: {line}"


SUCCESSES = {
    # The goal, 15, is reached from 14 by moving right or slipping there; 11 is a hole.
    "FrozenLake": [(14, 1), (14, 2), (14, 3)],
    "CliffWalking": [(35, 2)],
    # The passenger, who sits in the taxi (4), is dropped where he wants to go.
    "Taxi": [(16, 5), (97, 5), (418, 5), (479, 5)],
}


@pytest.mark.parametrize("name", SUCCESSES)
def test_the_transitions_that_count_as_success(name):
    found = np.argwhere(known.success_outcomes(make(name))).tolist()
    assert [(state, action) for state, action, _ in found] == SUCCESSES[name]


UP, DOWN, LEFT, RIGHT = (-1, 0), (1, 0), (0, -1), (0, 1)
LAYOUTS = {
    "Warehouse": ("...#.....G", {"#": "shelf"}, (UP, DOWN, LEFT, RIGHT)),
    "MineMaze": ("S..X..", {"X": "mine", "P": "power"}, (UP, DOWN, LEFT, RIGHT)),
    "still FrozenLake": ("S...", {"X": "hole"}, (LEFT, DOWN, RIGHT, UP)),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_moves_lead_where_the_layout_says(name):
    env = make(name)
    layout = grid_layout(gym.wrappers.RecordEpisodeStatistics(env))
    model = known.transition_model(env)
    first, names, moves = LAYOUTS[name]
    assert (layout.rows[0], layout.names, layout.moves) == (first, names, moves)
    assert layout.n_states == model.n_states
    letters = "".join(layout.rows)
    for state, action in zip(*np.nonzero(np.outer(model.reachable, [True] * 4)), strict=True):
        reached, cell = model.next_state[state, action, 0], layout.cells[state]
        row, column = np.divmod(cell, layout.n_columns) + np.array(layout.moves[action])
        inside = 0 <= row < layout.n_rows and 0 <= column < layout.n_columns
        target = row * layout.n_columns + column if inside else cell
        if letters[target] == "#":
            target = cell
        assert layout.cells[reached] == target
        assert letters[target] != "P" or target in layout.collected_in(layout.layers[reached])
        assert model.terminated[state, action, 0] == (letters[target] in "GX")
    assert {letters[start] for start in np.flatnonzero(model.initial)} == {"S"}


def test_layers_other_layouts_and_names():
    layout = grid_layout(make("MineMaze"))
    assert (layout.n_layers, layout.n_states, layout.prizes) == (8, 288, (9, 23, 31))
    # Row 2, column 4, with the first and the last power collected: 16 + 36 * 0b101.
    assert (layout.cells[196], layout.layers[196]) == (16, 5)
    assert layout.rows_in(5) == ("S..X..", ".X...X", ".X.X..", "...X.P", ".X...X", "..X..G")
    assert state_name(make("MineMaze"), layout, 196) == "row 3, column 5, 2 collected"
    field = grid_layout(gym.make("WindyGridworld-v0", moves="king_and_stay"))
    assert (field.rows[3], field.n_states) == ("S......G..", 70)
    diagonal = ((-1, -1), (-1, 1), (1, -1), (1, 1), (0, 0))
    assert field.moves == (UP, DOWN, LEFT, RIGHT, *diagonal)
    for env_id in ("Taxi-v4", "CartPole-v1"):
        assert grid_layout(gym.make(env_id)) is None
    for env_id, kwargs, place, names in (
        ("FrozenLake-v1", {}, slice(4), ("left", "down", "right", "up")),
        ("CartPole-v1", {}, slice(4), ()),
        ("Blackjack-v1", {}, slice(4), ("stick", "hit")),
        ("Taxi-v4", {}, slice(1, 5, 3), ("north", "pick up")),
        ("WindyGridworld-v0", {"moves": "king"}, slice(3, 5), ("right", "up left")),
    ):
        assert action_names(gym.make(env_id, **kwargs))[place] == names
    taxi = make("Taxi")
    state = taxi.unwrapped.encode(0, 3, 4, 1)
    assert state_name(taxi, None, state) == "row 1, column 4, passenger on board, to G"
    assert state_name(gym.make("RiverSwim-v0"), None, 3) == "state 3"
    hands = gym.wrappers.TimeLimit(wrappers.FlattenToDiscrete(gym.make("Blackjack-v1")), 9)
    assert state_name(hands, None, 394) == "state 394, seen as (17, 10, 0)"


DOCUMENT = Path(train.__file__).parent / "docs" / "evaluation.md"
KNOWN = brackets.known_entries().values()
ENTRIES = {entry["id"]: entry for limits in KNOWN for entry in limits.values()}


@pytest.mark.parametrize("name", ENTRIES)
def test_a_bracket_is_claimed_of_an_environment_as_it_is(name):
    entry = ENTRIES[name]
    low, high, base = entry["lower"], entry["upper"], entry["baseline"]["mean"]
    with gym.make(name) as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())  # it may have been played before
        is_proven = name != "Acrobot-v1"
        assert brackets.optimum_bracket(env) == brackets.OptimumBracket(low, high, base, is_proven)
        assert brackets.optimum_bracket(gym.wrappers.FlattenObservation(env)) is not None
    assert brackets.may_have_bracket(name)
    assert brackets.upper_is_proven(name) is is_proven
    assert base < low < entry["played"]["mean"] <= high
    apart = (high - low) / (low - base)
    assert apart < (0.06 if name == "Acrobot-v1" else 0.03)
    mark = "" if is_proven else " (not proven)"
    line = f"| `{name}` | {low:.2f} | {high:.2f}{mark} | {100 * apart:.1f} % | {base:.1f} |\n"
    assert line in DOCUMENT.read_text()


def changed(env_id, **attributes):
    env = gym.make(env_id)
    vars(env.unwrapped).update(attributes)
    return env


OTHERS = {
    "goal": lambda: gym.make("MountainCar-v0", goal_velocity=0.1),
    "limit": lambda: gym.make("CartPole-v1", max_episode_steps=400),
    "attribute": lambda: changed("CartPole-v1", gravity=5.0),
    "own step": lambda: changed("MountainCar-v0", step=MountainCarEnv().step),
    "scaled rewards": lambda: wrappers.ScaleReward(gym.make("CartPole-v1"), 2.0),
    "unknown wrapper": lambda: Anything(gym.make("CartPole-v1")),
}


@pytest.mark.parametrize("what", OTHERS)
def test_none_is_claimed_of_anything_else(what):
    with OTHERS[what]() as env:
        assert brackets.optimum_bracket(env) is None

"""The compiled loop ends in the same bits as the interpreted one: agents, worlds, settings."""

import copy
import itertools
from functools import partial
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import ClipReward, PassiveEnvChecker, TimeLimit
from stable_baselines3.common.utils import FloatSchedule

from agents import ALGORITHMS, load_algorithm
from agents.common.callbacks import BlockCallback, EpisodeBudget, Horizon, calls_until_multiple
from agents.tabular.one_step import QLearning
from agents.tabular.updates import td_learning
from envs.grid import GridWorld, Tile
from envs.wrappers import (
    ActionMasks,
    DiscretizeObservation,
    FlattenToDiscrete,
    IdleActionMasks,
    ScaleReward,
    TerminationReward,
)
from machine_code.compiling import inlined
from tests.agents.trainings import (
    AGENTS,
    CONSTANT,
    COOLING,
    LAKE,
    LESS,
    NOISE,
    assert_same,
    environment,
    make,
    state_of,
)

ENGINES = ("interpreted", "compiled")
HOUSE, SLIPPERY = "Warehouse-v0", {"slip": 0.2, "random_start": True}
IN_BINS = partial(
    DiscretizeObservation, bins=50, low=[-0.42, -0.87], high=[0.42, 0.87], dims=[2, 3]
)
SWING = {"low": [-2.4, -3, -0.21, -3], "high": [2.4, 3, 0.21, 3], "n_tiles": [2, 3, 6, 6]}
KING = {"moves": "king", "stochastic": True, "max_episode_steps": 99}
WORLDS = {
    "house": (HOUSE, SLIPPERY),
    "lake": (LAKE, {}),
    "Taxi": ("Taxi-v4", {}),
    "cliff": ("CliffWalking-v1", {}),
    "coins": ("BernoulliBandit-v0", {"probabilities": [0.0, 0.1, 1.0], "pulls": 33}),
    "segments": ("SegmentBandit-v0", {"batch_size": 8, "pulls": 50}),
    "gambler": ("GamblersProblem-v0", {"goal": 20}),
    "walk": ("RandomWalk-v0", {"n_states": 300, "max_jump": 30}),
    "wind": ("WindyGridworld-v0", KING),
}
for spec in list(gym.registry.values()):
    if str(spec.entry_point).startswith("envs.") and "Bandit" not in spec.id:
        is_grid = isinstance(gym.make(spec.id).unwrapped, GridWorld)
        WORLDS |= {spec.id: (spec.id, {})} if is_grid and spec.id != HOUSE else {}
TABULAR = [name for name, entry in ALGORITHMS.items() if entry.family == "tabular"]
TILED = [name for name, entry in ALGORITHMS.items() if entry.family == "linear"]


def both_shaped(env):
    return TerminationReward(ClipReward(ScaleReward(env, 0.1), -0.5, 0.9), -3.3)


def rows():
    """Each agent as the contract has it, in one of the worlds; and wrappers, vectors, masks."""
    numbers, places = itertools.cycle((1, 3, 8)), itertools.cycle(WORLDS)
    for name in TABULAR:
        place = next(places)
        yield f"{name} {place}", name, WORLDS[place], next(numbers), AGENTS[name][1]
    for name in TILED:
        env_id, settings = AGENTS[name]
        yield f"{name} {env_id}", name, (env_id, {}), 2, settings
    for wrapper in (both_shaped, FlattenToDiscrete, PassiveEnvChecker):
        slippery = HOUSE, {**SLIPPERY, "wrapper": wrapper}
        yield f"under {wrapper.__name__}", "sarsa", slippery, 2, {"learning_rate": 0.3}
    yield "bins of CartPole", "qlearning", ("CartPole-v1", {"wrapper": IN_BINS}), 2, LESS
    yield "tiles of CartPole", "semi_gradient_q", ("CartPole-v1", {}), 1, {**SWING, **LESS}
    # Episodes of 82 steps, more than there is room for at first.
    left_at_first = {"initial_preferences": [1.47, -1.47], "learning_rate": 0.002}
    yield "reinforce", "reinforce", ("ShortCorridor-v0", {}), 2, left_at_first
    # That all agents keep to masks is seen in test_masks.py, where steps are interpreted.
    masked = {"mask_actions": True}
    tiny = HOUSE, {"desc": ["S.", "#G"], "max_episode_steps": 5}
    still = LAKE, {"wrapper": IdleActionMasks, "is_slippery": False}
    noise = {**masked, **NOISE, "initial_q_std": 5.0}
    yield "noise masked", "sarsa", tiny, 1, noise
    yield "boltzmann masked", "sarsa", still, 3, {**masked, **COOLING}
    yield "masked", "dyna_q_plus", ("Taxi-v4", {"wrapper": ActionMasks}), 2, masked


ROWS = {row[0]: row[1:] for row in rows()}


def in_world(name, place, n_envs=1, folder=None, **settings):
    env_id, kwargs = place
    return make(name, environment(env_id, n_envs, folder=folder, **kwargs), **settings)


def assert_engines_agree(make_model, train):
    """The state after training is the same on either engine; returns the two models."""
    models = []
    for engine in ENGINES:
        models.append(make_model(engine=engine))
        train(models[-1])
        assert models[-1].engine_in_use.startswith(engine)
    assert_same(*map(state_of, models))
    return models


@pytest.mark.parametrize("row", ROWS)
def test_same_bits_also_where_engines_take_turns(row, tmp_path):
    name, place, n_envs, settings = ROWS[row]
    states = []
    for engines in (("interpreted",) * 3, ("compiled", "interpreted", "compiled")):
        folder = tmp_path / engines[0]
        model = in_world(name, place, n_envs, folder, **settings)
        for engine in engines:  # neither call ends where an episode does
            model.engine = engine
            model.learn(501, reset_num_timesteps=False)
            assert model.engine_in_use.startswith(engine)
        model.env.close()
        lines = [path.read_text().splitlines()[1:] for path in sorted(folder.glob("*.csv"))]
        written = [[line.split(",")[:2] for line in each] for each in lines]
        states.append({**state_of(model), "rows": written})
    assert_same(*states)
    assert states[0]["rows"][0][0] == ["r", "l"]
    table = getattr(model.policy, "q_tables", None)
    changed = model.policy.weights if table is None else model.policy.visit_counts
    assert changed.any()
    if settings.get("mask_actions"):
        masks = model.policy.masks
        masked = ~masks & masks.any(axis=1, keepdims=True)
        assert not model.policy.visit_counts.numpy()[:, masked].any()


def test_tiles_of_numbers_are_the_table_to_the_bit():
    models = []
    for each in ("semi_gradient_q", "qlearning"):
        model = in_world(each, WORLDS["lake"], 3, gamma=0.97, learning_rate=0.3)
        model.set_random_seed(1)  # the table has drawn its first entries
        models.append(model.learn(4000))
    weights, table = models[0].policy.weights.numpy(), models[1].policy.q_table
    assert weights.any()
    assert np.array_equal(weights, table)
    assert models[0].rng.bit_generator.state == models[1].rng.bit_generator.state
    assert models[0].mean_td_error == models[1].mean_td_error
    np.testing.assert_array_equal(*(model.action_probabilities() for model in models))


@pytest.mark.parametrize(
    ("decay", "name", "n_envs"), [("linear", "qlearning", 1), ("exponential", "sarsa", 3)]
)
def test_schedules_by_episodes(decay, name, n_envs):
    learn = partial(in_world, name, WORLDS["lake"], n_envs, exploration_decay=decay)
    models = assert_engines_agree(
        partial(learn, exploration_fraction=0.9),
        lambda model: model.learn(10**9, callback=EpisodeBudget(300)),
    )
    assert 300 <= models[0]._episode_num < 300 + n_envs
    assert models[0]._current_progress_remaining == pytest.approx(0.0, abs=n_envs / 300)


# --- changes in the middle of a training ---------------------------------------------------------


class Change(BlockCallback):
    """Does something to the agent on a call."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def horizon(self):
        return Horizon(calls=calls_until_multiple(self.n_calls, 500))

    def _on_step(self):
        if self.n_calls == 500:
            self.change(self.model)
        return True


def put(**attributes):
    def change(model):
        for name, value in attributes.items():
            setattr(model, name, value)

    return change


def replace_by_loading(model):
    state = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.policy.load_state_dict(state, assign=True)


def put_zeros(model):
    parameters = model.get_parameters()["policy"]
    model.set_parameters({"policy": {key: value * 0 for key, value in parameters.items()}})


def put_small_tables(model):
    model.policy.q_tables = th.zeros(1, 2, 4, dtype=th.float64)


def seed_the_environment_anew(model):
    model.env.envs[0].unwrapped.np_random = np.random.default_rng(3)


CHANGES = {
    "gamma": put(gamma=0.3),
    "sample averages": put(learning_rate="sample_average"),
    "epsilon": put(exploration_schedule=FloatSchedule(0.9)),
    "generator": lambda model: setattr(model, "rng", np.random.default_rng(5)),
    "environment's generator": seed_the_environment_anew,
    "zeros that are loaded": put_zeros,
    "tables of the same values": replace_by_loading,
}


@pytest.mark.parametrize(
    ("name", "what"), [*(("sarsa", what) for what in CHANGES), ("double_qlearning", [*CHANGES][-1])]
)
def test_a_change_counts_in_both_loops(name, what):
    start = {"initial_q": 0.5 * what.startswith("zeros"), **CONSTANT}
    lake, change = partial(in_world, name, WORLDS["lake"], **start), Change(CHANGES[what])
    models = assert_engines_agree(lake, lambda m: m.learn(1000, callback=copy.copy(change)))
    same = np.array_equal(models[0].policy.q_tables, lake().learn(1000).policy.q_tables)
    assert same == (what == "tables of the same values")
    if what == "zeros that are loaded":  # the step on which they were is learnt from afterwards
        assert int(models[0].policy.visit_counts.sum()) == 501


def house_of(change):
    return WORLDS["house"], lambda env: change(env.unwrapped.dynamics)


def lake_of(change):
    return WORLDS["lake"], lambda env: change(env.unwrapped)


def wrapped(wrapper, **attributes):
    """FrozenLake under a wrapper of rewards or time, some of whose attributes are set by hand."""

    def change(env):
        while not isinstance(env, wrapper.func):
            env = env.env
        vars(env).update(attributes)

    return (LAKE, {"wrapper": None if wrapper.func is TimeLimit else wrapper}), change


HALVES = [0.5, 0.5]
BY_HAND = {  # a world, and what is done to it between two trainings
    "an outcome in place": lake_of(lambda env: env.P[0][2].__setitem__(1, (1 / 3, 5, 0.5, True))),
    "a start": lake_of(lambda env: env.initial_state_distrib.__setitem__(slice(2), HALVES)),
    "a tile": house_of(lambda house: house.tiles.update({ord("#"): Tile(-7, blocked=True)})),
    "a scale": wrapped(partial(ScaleReward, scale=2.0), scale=3.0),
    "the last reward": wrapped(partial(TerminationReward, reward=-1.0), last_reward=-2.0),
    "the time limit": wrapped(partial(TimeLimit), _max_episode_steps=7),
}


@pytest.mark.parametrize("what", BY_HAND)
def test_a_change_of_the_environment_by_hand_counts_and_for_it_alone(what):
    place, change = BY_HAND[what]
    lasting = partial(in_world, "sarsa", place, learning_rate=0.3, initial_q=1.0)

    def train(model):
        model.learn(300)
        change(model.env.envs[0])
        model.learn(700, reset_num_timesteps=False)

    changed, _ = assert_engines_agree(lasting, train)
    alone = lasting().learn(300).learn(700, reset_num_timesteps=False)
    assert not np.array_equal(changed.policy.q_table, alone.policy.q_table)


def test_what_does_not_fit_any_more_is_refused():
    for change, line in (
        (put_small_tables, r"tables must be 1 or 2, of shape \(1, 16, 4\), not"),
        (put(env=environment(LAKE, 5)), "the agent works on 1 environments, not 5"),
    ):
        model = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0)
        change(model)
        with pytest.raises(ValueError, match=line):
            model.learn(10)


# --- a memory of an agent's own ------------------------------------------------------------------


class Footprints(NamedTuple):
    """How often each environment was in each state, shape (n_envs, S)."""

    visits: np.ndarray


@inlined
def learning_with_footprints(agent, worlds, progress):
    """Q-learning that notes where it was, and is paid for having been there before."""
    for i in range(len(worlds)):
        agent.memory.visits[i, worlds[i].obs] += 1
        worlds[i].reward += 0.001 * agent.memory.visits[i, worlds[i].obs]
    td_learning(agent, worlds, progress)


class Walker(QLearning):
    """An agent with a memory."""

    learn_from_step = learning_with_footprints

    def _make_memory(self):
        return Footprints(np.zeros((self.n_envs, int(self.observation_space.n)), dtype=np.int64))


def walker(engine="compiled"):
    return Walker(env=environment(LAKE, 2), seed=1, engine=engine)


def forget(model):
    model._memory = Footprints(np.zeros((2, 16), dtype=np.int64))


def misshape(model):
    model._memory = Footprints(np.zeros((1, 16), dtype=np.int64))


def test_both_loops_work_on_a_memory_in_place(tmp_path):
    models = assert_engines_agree(walker, lambda m: m.learn(1200, callback=Change(forget)))
    # The step on which a callback acts is learnt from after it.
    assert models[1]._memory.visits.sum(axis=1).tolist() == [101, 101]
    # Another training begins with nothing, as does what was loaded; one that goes on keeps it.
    assert models[1].learn(200)._memory.visits.sum() == 200
    assert models[1].learn(200, reset_num_timesteps=False)._memory.visits.sum() == 400
    models[1].save(tmp_path / "model")
    loaded = Walker.load(tmp_path / "model", environment(LAKE, 3))
    assert loaded._memory.visits.tolist() == np.zeros((3, 16)).tolist()
    for model in models:
        with pytest.raises(ValueError, match=r"must be of shape \(2, 16\) and int64, not \("):
            model.learn(1200, callback=Change(misshape))

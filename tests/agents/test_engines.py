"""The compiled loop ends in the same bits as the interpreted one: agents, worlds, settings."""

import gc
import itertools
from functools import partial
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.wrappers import ClipReward, PassiveEnvChecker, TimeLimit
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule

import envs  # noqa: F401  # registers the environments
from agents import ALGORITHMS, load_algorithm
from agents.common.callbacks import BlockCallback, EpisodeBudget, Horizon, calls_until_multiple
from agents.common.schedules import ExponentialSchedule
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

ENGINES = ("interpreted", "compiled")
IN_BINS = partial(
    DiscretizeObservation, bins=50, low=[-0.42, -0.87], high=[0.42, 0.87], dims=[2, 3]
)
SWING = {"low": [-2.4, -3, -0.21, -3], "high": [2.4, 3, 0.21, 3], "n_tiles": [2, 3, 6, 6]}


def world(env_id, wrapper=None, **kwargs):
    return env_id, kwargs, wrapper


WORLDS = {
    "slippery Warehouse": world("Warehouse-v0", slip=0.2, random_start=True),
    "FrozenLake": world("FrozenLake-v1"),
    "Taxi": world("Taxi-v4"),
    "CliffWalking": world("CliffWalking-v1"),
    "CartPole": world("CartPole-v1", IN_BINS),
    "coins": world("BernoulliBandit-v0", probabilities=[0.0, 0.1, 1.0], pulls=33),
    "segments": world("SegmentBandit-v0", batch_size=8, pulls=50),
    "gambler": world("GamblersProblem-v0", goal=20),
    "walk": world("RandomWalk-v0", n_states=300, max_jump=30),
    "wind": world("WindyGridworld-v0", moves="king", stochastic=True, max_episode_steps=99),
}
for spec in list(gym.registry.values()):
    if str(spec.entry_point).startswith("envs.") and "Bandit" not in spec.id:
        base = gym.make(spec.id).unwrapped
        WORLDS |= {spec.id: world(spec.id)} if isinstance(base, GridWorld) else {}
EXPLORATION = {
    "linear": {},
    "constant": {"exploration_decay": "constant", "exploration_initial_eps": 0.1},
    "exponential": {"exploration_decay": "exponential", "exploration_fraction": 0.7},
    "boltzmann": {"exploration": "boltzmann", "temperature": LinearSchedule(5.0, 0.2, 0.8)},
    "gaussian": {"exploration": "gaussian_noise", "noise_std": 20.0},
}
STEP_SIZES = {
    "constant": 0.2,
    "falling": LinearSchedule(0.8, 0.05, 0.9),
    "exponential": ExponentialSchedule(0.8, 0.01),
    "average": "sample_average",
}
NEEDING_PROBABILITIES = {"expected_sarsa", "n_step_tree_backup", "off_policy_monte_carlo"}
OWN = {
    "dyna_q": {"outcomes_kept": 3, "skip_terminal_update": True},
    "prioritized_sweeping": {"planning_steps": 1, "initial_q_std": 1.0},
    "r_max": {"known_after": 3, "value_bound": 1.0},
    "qlearning_ucb": {"value_bound": 1.0, "horizon": 30.0},
}
TABULAR = [name for name, entry in ALGORITHMS.items() if entry.family == "tabular"]


def settings_of(name, exploration, step_size, ties):
    """Those of the table that the agent has, and its own."""
    parameters = load_algorithm(name).__signature__.parameters
    chosen = {**EXPLORATION[exploration], "tie_breaking": ties, **OWN.get(name, {})}
    if name != "off_policy_monte_carlo":
        chosen["learning_rate"] = STEP_SIZES[step_size]
    return {key: value for key, value in chosen.items() if key in parameters}


def both_shaped(env):
    return TerminationReward(ClipReward(ScaleReward(env, 0.1), -0.5, 0.9), -3.3)


def rows():
    """Each agent on three worlds, each world with one agent or more; settings take turns."""
    turns = [itertools.cycle(each) for each in (EXPLORATION, STEP_SIZES, ("random", "first"))]
    places, numbers = itertools.cycle(WORLDS), itertools.cycle((1, 3, 8))
    for name in [*TABULAR, *TABULAR, *TABULAR]:
        exploration, step_size, ties = map(next, turns)
        if name in NEEDING_PROBABILITIES and exploration == "gaussian":
            exploration = "linear"
        place = next(places)
        if place == "CartPole" and name not in ("qlearning", "sarsa"):
            place = "FrozenLake"  # what agents remember has nothing to do with what they observe
        settings = settings_of(name, exploration, step_size, ties)
        row = f"{name} {place} {exploration} {step_size}"
        yield row, name, WORLDS[place], next(numbers), settings
    for wrapper in (both_shaped, FlattenToDiscrete, PassiveEnvChecker):
        slippery = world("Warehouse-v0", wrapper, slip=0.2, random_start=True)
        yield f"under {wrapper.__name__}", "sarsa", slippery, 2, {"learning_rate": 0.3}
    for name, ties in (("qlearning", "random"), ("sarsa", "first")):
        settings = settings_of(name, "linear", "falling", ties)
        yield f"{name} CartPole", name, WORLDS["CartPole"], 2, settings
    masked = {"mask_actions": True}
    tiny = world("Warehouse-v0", desc=["S.", "#G"], max_episode_steps=5)
    still = world("FrozenLake-v1", IdleActionMasks, is_slippery=False)
    for i, name in enumerate(TABULAR):
        place = (WORLDS["Taxi"], world("Taxi-v4", ActionMasks), tiny, still)[i % 4]
        yield f"{name} masked", name, place, 1 + i % 3, {**masked, **OWN.get(name, {})}
    yield "gaussian masked", "qlearning", tiny, 1, {**masked, **EXPLORATION["gaussian"]}
    for name in ("semi_gradient_sarsa", "semi_gradient_q", "actor_critic"):
        schedule = {"learning_rate": STEP_SIZES["falling"]}
        yield f"{name} FrozenLake", name, WORLDS["FrozenLake"], 2, {"gamma": 0.9, **schedule}
    yield "tiles MountainCar", "semi_gradient_sarsa", world("MountainCar-v0"), 2, {}
    swing = {**SWING, "learning_rate": 0.3}
    yield "tiles CartPole", "semi_gradient_q", world("CartPole-v1"), 1, swing
    left_at_first = {"initial_preferences": [1.47, -1.47], "learning_rate": 0.002}
    # Episodes of 82 steps, more than there is room for at first.
    corridor = world("ShortCorridor-v0")
    yield "reinforce", "reinforce", corridor, 2, left_at_first
    yield "reinforce value", "reinforce", corridor, 2, {**left_at_first, "baseline": "value"}


ROWS = {row[0]: row[1:] for row in rows()}


def make(name, place, n_envs=1, folder=None, **settings):
    env_id, env_kwargs, wrapper = place
    folder = None if folder is None else str(folder)
    env = make_vec_env(
        env_id, n_envs, 3, env_kwargs=env_kwargs, wrapper_class=wrapper, monitor_dir=folder
    )
    return load_algorithm(name)(env=env, **{"seed": 1, **settings})


def state_of(model):
    """Everything that what comes next depends on, and everything that statistics are made of."""
    counts = model.num_timesteps, model._total_timesteps, model._episode_num, model._n_updates
    state = {key: value.numpy().tobytes() for key, value in model.policy.state_dict().items()}
    state |= {
        "generator": model.rng.bit_generator.state,
        "action generator": model.action_space.np_random.bit_generator.state,
        "observations": np.asarray(model._last_obs).tolist(),
        "episode starts": model._last_episode_starts.tolist(),
        "pending actions": model._next_actions.tolist(),
        "memory": [array.tobytes() for array in getattr(model, "_memory", ())],
        "counts": (*counts, model._current_progress_remaining, model.mean_td_error),
        "returns": [(info["r"], info["l"]) for info in model.ep_info_buffer],
        "successes": [bool(success) for success in model.ep_success_buffer],
    }
    names = ("episode_returns", "episode_lengths", "rewards", "total_steps", "needs_reset")
    for i, env in enumerate(model.env.envs):
        places = [vars(env.unwrapped).get(name) for name in ("s", "state", "context", "place")]
        state[f"place of {i}"] = [np.asarray(place).tolist() for place in places]
        state[f"Monitor of {i}"] = [env.get_wrapper_attr(name) for name in names]
        limited = env.has_wrapper_attr("_elapsed_steps")
        state[f"time of {i}"] = limited and env.get_wrapper_attr("_elapsed_steps")
        state[f"generator of {i}"] = env.unwrapped.np_random.bit_generator.state
    return state


def assert_same(states):
    for other in states[1:]:
        assert states[0].keys() == other.keys()
        assert [key for key in other if other[key] != states[0][key]] == []


def assert_engines_agree(make_model, train):
    """The state after training is the same on either engine; returns the two models."""
    models = []
    for engine in ENGINES:
        models.append(make_model(engine=engine))
        train(models[-1])
        assert models[-1].engine_in_use.startswith(engine)
    assert_same([state_of(model) for model in models])
    return models


@pytest.mark.parametrize("row", ROWS)
def test_same_bits_also_where_engines_take_turns(row, tmp_path):
    name, place, n_envs, settings = ROWS[row]
    states = []
    for engines in (("interpreted",) * 2, ("compiled",) * 2, ("compiled", "interpreted")):
        folder = tmp_path / "-".join(engines)
        model = make(name, place, n_envs, folder, **settings)
        for engine in engines:  # neither call ends where an episode does
            model.engine = engine
            model.learn(1511, reset_num_timesteps=False)
            assert model.engine_in_use.startswith(engine)
        model.env.close()
        files = sorted(folder.glob("*.csv"))
        lines = [path.read_text().splitlines()[1:] for path in files]
        rows = [[line.split(",")[:2] for line in each] for each in lines]
        states.append({**state_of(model), "rows": rows})
    assert_same(states)
    assert states[0]["rows"][0][0] == ["r", "l"]
    table = getattr(model.policy, "q_tables", None)
    changed = model.policy.weights if table is None else model.policy.visit_counts
    assert changed.any()
    if settings.get("mask_actions"):
        masks = model.policy.masks
        masked = ~masks & masks.any(axis=1, keepdims=True)
        assert not model.policy.visit_counts.numpy()[:, masked].any()


@pytest.mark.parametrize(
    ("tiled", "name"), [("semi_gradient_sarsa", "sarsa"), ("semi_gradient_q", "qlearning")]
)
def test_tiles_of_numbers_are_the_table_to_the_bit(tiled, name):
    models = []
    for each in (tiled, name):
        model = make(each, WORLDS["FrozenLake"], 3, gamma=0.97, learning_rate=0.3)
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
    learn = partial(make, name, WORLDS["FrozenLake"], n_envs, exploration_decay=decay)
    models = assert_engines_agree(
        partial(learn, exploration_fraction=0.9),
        lambda model: model.learn(10**9, callback=EpisodeBudget(300)),
    )
    assert 300 <= models[0]._episode_num < 300 + n_envs
    assert models[0]._current_progress_remaining == pytest.approx(0.0, abs=n_envs / 300)


# --- changes in the middle of a training ---------------------------------------------------------


class Change(BlockCallback):
    """Does something to the agent on a call."""

    def __init__(self, change, call=500):
        super().__init__()
        self.change, self.call = change, call

    def horizon(self):
        return Horizon(calls=calls_until_multiple(self.n_calls, self.call))

    def _on_step(self):
        if self.n_calls == self.call:
            self.change(self.model)
            gc.collect()  # nobody else keeps what was replaced
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
    "ties": put(tie_breaking="first"),
    "generator": lambda model: setattr(model, "rng", np.random.default_rng(5)),
    "environment's generator": seed_the_environment_anew,
    "zeros in the tables": lambda model: model.policy.q_tables.zero_(),
    "zeros that are loaded": put_zeros,
    "tables of the same values": replace_by_loading,
}


@pytest.mark.parametrize("name", ["sarsa", "double_qlearning"])
@pytest.mark.parametrize("what", CHANGES)
def test_a_change_counts_in_both_loops(name, what):
    start = {"initial_q": 0.5 * what.startswith("zeros"), **EXPLORATION["constant"]}
    lake = partial(make, name, WORLDS["FrozenLake"], **start)
    change = CHANGES[what]
    models = assert_engines_agree(lake, lambda m: m.learn(2000, callback=Change(change, 1000)))
    same = np.array_equal(models[0].policy.q_tables, lake().learn(2000).policy.q_tables)
    assert same == (what == "tables of the same values")
    if what == "zeros that are loaded":  # the step on which they were is learnt from afterwards
        assert int(models[0].policy.visit_counts.sum()) == 1001


def house_of(change):
    return world("Warehouse-v0"), lambda env: change(env.unwrapped.dynamics)


def lake_of(change):
    return world("FrozenLake-v1"), lambda env: change(env.unwrapped)


def wrapped(wrapper, **attributes):
    """FrozenLake under a wrapper of rewards or time, some of whose attributes are set by hand."""

    def change(env):
        while not isinstance(env, wrapper.func):
            env = env.env
        vars(env).update(attributes)

    return world("FrozenLake-v1", None if wrapper.func is TimeLimit else wrapper), change


HALVES = [0.5, 0.5]
HALVES = [0.5, 0.5]
BY_HAND = {  # a world, and what is done to it between two trainings
    "an outcome in place": lake_of(lambda env: env.P[0][2].__setitem__(1, (1 / 3, 5, 0.5, True))),
    "a model": lake_of(lambda env: setattr(env, "P", FrozenLakeEnv(is_slippery=False).P)),
    "a start": lake_of(lambda env: env.initial_state_distrib.__setitem__(slice(2), HALVES)),
    "a tile": house_of(lambda house: house.tiles.update({ord("#"): Tile(-7, blocked=True)})),
    "the edge": house_of(lambda house: setattr(house, "edge", Tile(-3, blocked=True))),
    "a scale": wrapped(partial(ScaleReward, scale=2.0), scale=3.0),
    "the last reward": wrapped(partial(TerminationReward, reward=-1.0), last_reward=-2.0),
    "the time limit": wrapped(partial(TimeLimit), _max_episode_steps=7),
}


@pytest.mark.parametrize("what", BY_HAND)
def test_a_change_of_the_environment_by_hand_counts_and_for_it_alone(what):
    place, change = BY_HAND[what]
    lasting = partial(make, "sarsa", place, learning_rate=0.3, initial_q=1.0)

    def train(model):
        model.learn(300)
        change(model.env.envs[0])
        model.learn(700, reset_num_timesteps=False)

    changed, _ = assert_engines_agree(lasting, train)
    alone, _ = assert_engines_agree(
        lasting, lambda model: model.learn(300).learn(700, reset_num_timesteps=False)
    )
    assert not np.array_equal(changed.policy.q_table, alone.policy.q_table)


def test_what_does_not_fit_any_more_is_refused():
    for change, line in (
        (put_small_tables, r"tables must be 1 or 2, of shape \(1, 16, 4\), not"),
        (put(env=make_vec_env("FrozenLake-v1", 5)), "the agent works on 1 environments, not 5"),
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
    return Walker(env=make_vec_env("FrozenLake-v1", 2, seed=3), seed=1, engine=engine)


def forget(model):
    model._memory = Footprints(np.zeros((2, 16), dtype=np.int64))


def misshape(model):
    model._memory = Footprints(np.zeros((1, 16), dtype=np.int64))


@pytest.mark.parametrize("change", [None, forget])
def test_both_loops_work_on_a_memory_in_place(change, tmp_path):
    models = assert_engines_agree(
        walker, lambda model: model.learn(2000, callback=change and Change(change))
    )
    # The step on which a callback acts is learnt from after it.
    share = 1000 if change is None else 501
    assert models[1]._memory.visits.sum(axis=1).tolist() == [share, share]
    # Another training begins with nothing, as does what was loaded; one that goes on keeps it.
    assert models[1].learn(200)._memory.visits.sum() == 200
    assert models[1].learn(200, reset_num_timesteps=False)._memory.visits.sum() == 400
    models[1].save(tmp_path / "model")
    loaded = Walker.load(tmp_path / "model", make_vec_env("FrozenLake-v1", 3))
    assert loaded._memory.visits.tolist() == np.zeros((3, 16)).tolist()
    for model in models:
        with pytest.raises(ValueError, match=r"must be of shape \(2, 16\) and int64, not \("):
            model.learn(2000, callback=Change(misshape))

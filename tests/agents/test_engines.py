"""The compiled loop ends in the same bits as the interpreted one: agents, worlds, settings."""

import copy
import itertools
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import ClipReward, TimeLimit
from stable_baselines3.common import callbacks as sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.agents.common.callbacks import EpisodeBudget
from rl_yardstick.envs import published_models
from rl_yardstick.envs import wrappers as wrap
from rl_yardstick.envs.grid import Tile
from rl_yardstick.envs.known_models import transition_model
from tests.agents import trainings
from tests.envs.corridors import Backwards, Corridor, Deaf, outcomes

LAKE, ENGINES = trainings.LAKE, ("interpreted", "compiled")
HOUSE, SLIPPERY = "Warehouse-v0", {"slip": 0.2, "random_start": True}
IN_BINS = partial(
    wrap.DiscretizeObservation, bins=50, low=[-0.42, -0.87], high=[0.42, 0.87], dims=[2, 3]
)
SWING = {"low": [-2.4, -3, -0.21, -3], "high": [2.4, 3, 0.21, 3], "n_tiles": [2, 3, 6, 6]}
KING = {"moves": "king", "stochastic": True, "max_episode_steps": 99}
WORLDS = {
    "house": (HOUSE, SLIPPERY),
    "lake": (LAKE, {}),
    "Taxi": ("Taxi-v4", {}),
    "cliff": ("CliffWalking-v1", {}),
    "gambler": ("GamblersProblem-v0", {"goal": 20}),
    "walk": ("RandomWalk-v0", {"n_states": 300, "max_jump": 30}),
    "wind": ("WindyGridworld-v0", KING),
}
TABULAR = [name for name, entry in ALGORITHMS.items() if entry.family == "tabular"]
TILED = [name for name, entry in ALGORITHMS.items() if entry.family == "linear"]


def both_shaped(env):
    return wrap.TerminationReward(ClipReward(wrap.ScaleReward(env, 0.1), -0.5, 0.9), -3.3)


AGENTS, MASKED = trainings.AGENTS, {"mask_actions": True}
TURNS = zip(TABULAR, itertools.cycle(WORLDS), itertools.cycle((1, 3, 8)))
ROWS = {  # each agent as the contract has it, in one of the worlds; and wrappers, vectors, masks
    **{f"{name} {place}": (name, WORLDS[place], n, AGENTS[name][1]) for name, place, n in TURNS},
    **{name: (name, (AGENTS[name][0], {}), 2, AGENTS[name][1]) for name in TILED},
    "under three": ("sarsa", (HOUSE, {**SLIPPERY, "wrapper": both_shaped}), 2, {}),
    "flat": ("sarsa", (HOUSE, {**SLIPPERY, "wrapper": wrap.FlattenToDiscrete}), 2, {}),
    "bins": ("qlearning", ("CartPole-v1", {"wrapper": IN_BINS}), 2, trainings.LESS),
    "tiles": ("semi_gradient_q", ("CartPole-v1", {}), 1, {**SWING, **trainings.LESS}),
    # Episodes of 82 steps, more than there is room for at first.
    "long": ("reinforce", ("ShortCorridor-v0", {}), 2,
        {"initial_preferences": [1.47, -1.47], "learning_rate": 0.002}),
    # That all agents keep to masks is seen in test_masks.py, where steps are interpreted.
    "noise masked": ("sarsa", (HOUSE, {"desc": ["S.", "#G"], "max_episode_steps": 5}), 1,
        {**MASKED, **trainings.NOISE, "initial_q_std": 5.0}),
    "masked": ("dyna_q_plus", ("Taxi-v4", {"wrapper": wrap.ActionMasks}), 2, MASKED),
}  # fmt: skip


def in_world(name, place, n_envs=1, folder=None, **settings):
    env_id, kwargs = place
    env = trainings.environment(env_id, n_envs, folder=folder, **kwargs)
    return trainings.make(name, env, **settings)


def assert_engines_agree(make_model, train):
    """The state after training is the same on either engine; returns the two models."""
    models = []
    for engine in ENGINES:
        models.append(make_model(engine=engine))
        train(models[-1])
        assert models[-1].engine_in_use.startswith(engine)
    trainings.assert_same(*map(trainings.state_of, models))
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
        states.append({**trainings.state_of(model), "rows": written})
    trainings.assert_same(*states)
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


def test_schedules_by_episodes():
    learn = partial(in_world, "sarsa", WORLDS["lake"], 3, exploration_decay="exponential")
    models = assert_engines_agree(
        partial(learn, exploration_fraction=0.9),
        lambda model: model.learn(10**9, callback=EpisodeBudget(300)),
    )
    assert 300 <= models[0]._episode_num < 303
    assert models[0]._current_progress_remaining == pytest.approx(0.0, abs=0.01)


def put_zeros(model):
    parameters = model.get_parameters()["policy"]
    model.set_parameters({"policy": {key: value * 0 for key, value in parameters.items()}})


CHANGES = {
    "gamma": lambda model: vars(model).update(gamma=0.3),
    "sample averages": lambda model: vars(model).update(learning_rate="sample_average"),
    "epsilon": lambda model: vars(model).update(exploration_schedule=FloatSchedule(0.9)),
    "generator": lambda model: vars(model).update(rng=np.random.default_rng(5)),
    "zeros that are loaded": put_zeros,
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_change_counts_in_both_loops(what):
    start = {"initial_q": 0.5 * what.startswith("zeros"), **trainings.CONSTANT}
    lake = partial(in_world, "sarsa", WORLDS["lake"], **start)
    change = trainings.Every(501, CHANGES[what])
    models = assert_engines_agree(lake, lambda m: m.learn(1000, callback=copy.copy(change)))
    assert not np.array_equal(models[0].policy.q_tables, lake().learn(1000).policy.q_tables)


def set_pole(env):
    vars(env.unwrapped).update(gravity=1.62, force_mag=3.0, kinematics_integrator="semi-implicit")


BY_HAND = {  # an agent, a world, and what is done to it between two trainings
    "an outcome in place": (
        "sarsa", WORLDS["lake"],
        lambda env: env.unwrapped.P[0][2].__setitem__(1, (1 / 3, 5, 0.5, True))),
    "a tile": (
        "sarsa", WORLDS["house"],
        lambda env: env.unwrapped.dynamics.tiles.update({ord("#"): Tile(-7, blocked=True)})),
    "the time limit": (
        "sarsa", WORLDS["lake"], lambda env: env.set_wrapper_attr("_max_episode_steps", 7)),
    "a pole on the moon": ("semi_gradient_q", ("CartPole-v1", {}), set_pole),
}  # fmt: skip


@pytest.mark.parametrize("what", BY_HAND)
def test_a_change_of_the_environment_by_hand_counts_and_for_it_alone(what):
    name, place, change = BY_HAND[what]
    swing = SWING if place[0] == "CartPole-v1" else {}
    lasting = partial(in_world, name, place, learning_rate=0.3, initial_q=1.0, **swing)

    def train(model):
        model.learn(300)
        change(model.env.envs[0])
        model.learn(700, reset_num_timesteps=False)

    changed, _ = assert_engines_agree(lasting, train)
    alone = lasting().learn(300).learn(700, reset_num_timesteps=False)
    states = [model.policy.state_dict().values() for model in (changed, alone)]
    assert not all(map(th.equal, *states))


def lake(**kwargs):
    return make_vec_env("FrozenLake-v1", 1, seed=0, **kwargs)


@pytest.fixture(autouse=True)
def nothing_is_checked(monkeypatch):
    """Each test checks models anew."""
    monkeypatch.setattr(published_models, "_checks", {})


def calm():
    """A corridor that tells of no wind, though it blows."""
    return TimeLimit(Corridor(outcomes(wind=0.0)), 10)


INTERPRETED = {  # reason: environment, settings, callback
    "VecNormalize is not DummyVecEnv": (lambda: VecNormalize(lake(), norm_obs=False),),
    "Wrapper must see every step$": (partial(lake, wrapper_class=gym.Wrapper),),
    "rewards are drawn, and the environment's model": (partial(gym.make, "MaximizationBias-v0"),),
    "the environments are not alike": (
        lambda: DummyVecEnv([lambda: gym.make(LAKE), lambda: gym.make(LAKE, is_slippery=False)]),),
    "the environment is shown on the screen": (partial(lake, env_kwargs={"render_mode": "human"}),),
    "a time limit lies outside Monitor": (
        partial(lake, wrapper_class=partial(TimeLimit, max_episode_steps=9)),),
    "under DiscretizeObservation and Monitor alone": (
        lambda: IN_BINS(gym.wrappers.Autoreset(gym.make("CartPole-v1"))),),
    "does not continue from the state": (lambda: TimeLimit(Deaf(), 10),),
    "the environment's P is not what step does: state ": (calm,),
    "schedule is a Python function": (lake, {"learning_rate": lambda progress: 0.1 * progress}),
    "ConvertCallback must be asked after each step": (lake, {}, lambda: lambda local, _: True),
    "Plain must be asked after each step$": (
        lake, {},
        lambda: [sb3.CallbackList([trainings.Plain()]), sb3.StopTrainingOnMaxEpisodes(5)]),
}  # fmt: skip


@pytest.mark.parametrize("reason", INTERPRETED)
def test_what_is_interpreted_and_why(reason):
    make_env, *rest = INTERPRETED[reason]
    settings, callback = (*rest, *({}, None)[len(rest) :])
    env, callback = make_env(), callback and callback()
    model = load_algorithm("qlearning")(env=env, engine="compiled", seed=0, **settings)
    with pytest.raises(ValueError, match=f"engine: compiled is not possible: .*{reason}"):
        model.learn(2, callback=callback)
    model.engine = "auto"
    model.learn(2, callback=callback)
    assert model.engine_in_use.startswith("interpreted: ")
    env.close()


def played(kind, engine, **settings):
    env = TimeLimit(kind(), 50)
    uniform = {"exploration_initial_eps": 1.0, "exploration_final_eps": 1.0}
    model = load_algorithm("qlearning")(env=env, engine=engine, seed=4, **uniform, **settings)
    return model.learn(8_000)


def test_an_environment_of_ones_own_ends_in_the_same_bits_if_it_draws_as_toy_text_does():
    models = [played(Corridor, engine) for engine in ("interpreted", "auto")]
    assert [model.engine_in_use for model in models] == ["interpreted: asked for", "compiled"]
    np.testing.assert_array_equal(*(model.policy.q_table for model in models))
    words = {
        "auto": "interpreted: the environment draws in its own way. Compiled training would be "
        "equal in distribution only (engine: compiled accepts that)",
        "compiled": "compiled, not bit for bit: the environment draws in its own way",
    }
    tables, expected = [], transition_model(Backwards()).expected_reward
    for engine, said in words.items():
        model = played(Backwards, engine, gamma=0.0, learning_rate="sample_average")
        assert model.engine_in_use == said
        tables.append(np.asarray(model.policy.q_table))
        # With averages and no discount each value is the mean of the pair's rewards, which are -1
        # but for the goal's 9, with a chance of 0.7: five standard errors.
        n = np.maximum(model.policy.visit_counts.numpy()[0], 1)
        spread = np.where(expected == -1, 0, 10 * np.sqrt(0.7 * 0.3 / n))
        visited = model.policy.visit_counts.numpy()[0] > 50
        assert visited[:4].all()
        assert (np.abs(tables[-1] - expected) <= 5 * spread + 1e-9)[visited].all()
    assert not np.array_equal(*tables)
    with pytest.raises(ValueError, match="whose transition model is known: the environment's P is"):
        load_algorithm("value_iteration")(env=calm()).learn(10)


@pytest.mark.parametrize("name", ["qlearning", "epsilon_greedy"])
def test_an_observation_outside_of_the_space_is_refused(name):
    """Compiled code would read and write beside the table."""
    for outside in (4, 10**9, -1):
        for shown in ((outside, 0), (0, outside)):
            env = trainings.Unknown(spaces.Discrete(4), None, *shown, ends=0)
            model = load_algorithm(name)(env=env, seed=0)
            with pytest.raises(ValueError, match=rf"{outside} is not in Discrete\(4\)"):
                model.learn(5)


def test_what_python_does_instead_is_not_compiled_away():
    class OwnLearning(load_algorithm("qlearning")):
        def _learn_from(self, transitions):
            pass

    model = OwnLearning(env="FrozenLake-v1", seed=0).learn(0)
    reason = "OwnLearning has a _learn_from of its own in Python"
    assert model.engine_in_use == f"interpreted: {reason}"
    with pytest.raises(TypeError, match=r"Plain.next_value is called by compiled code: put @inl"):

        class Plain(load_algorithm("qlearning")):
            def next_value(agent, env, progress, table):  # noqa: N805
                return 0.0

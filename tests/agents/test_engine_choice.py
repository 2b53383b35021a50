"""When a training of a table runs compiled, and what is said when it does not."""

import functools
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.classic_control import MountainCarEnv
from gymnasium.envs.toy_text.utils import categorical_sample
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from envs import checking as model_checks
from envs.grid import Tile
from envs.known_models import transition_model
from envs.wrappers import DiscretizeObservation, TerminationReward
from machine_code.compiling import inlined
from tests.envs.corridors import Corridor, Deaf, outcomes, with_p


class Foreign(gym.Wrapper):
    """Nobody knows what it does."""


class Wind(gym.Env):
    """Three states in a ring: forwards by action + 1, or not at all; nothing ends it."""

    observation_space, action_space = spaces.Discrete(3), spaces.Discrete(2)
    initial_state_distrib = np.array([0.5, 0.5, 0.0])

    def __init__(self):
        self.P = {
            s: {
                a: [(0.7, (s + a + 1) % 3, 1.0 + s, False), (0.3, s, -2.0 * a, False)]
                for a in (0, 1)
            }
            for s in range(3)
        }

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = int(categorical_sample(self.initial_state_distrib, self.np_random))
        return self.s, {}

    def step(self, action):
        row = self.P[self.s][int(action)]
        _, self.s, reward, terminated = row[self.draw(row)]
        return self.s, reward, terminated, False, {}

    def draw(self, row):
        return categorical_sample([outcome[0] for outcome in row], self.np_random)


class OwnWay(Wind):
    """The stillness comes first."""

    def draw(self, row):
        return int(self.np_random.random() < row[1][0])


class Curious(BaseCallback):
    seen = 0

    def _on_step(self):
        self.seen += 1
        return True


class LoudCheckpoint(CheckpointCallback):
    """A subclass may do anything on any step."""


def lake(**kwargs):
    return make_vec_env("FrozenLake-v1", 1, seed=0, **kwargs)


def pole(wrapper=lambda env: env, gravity=9.8, **kwargs):
    env = gym.make("CartPole-v1", **kwargs)
    env.unwrapped.gravity = gravity
    return DiscretizeObservation(wrapper(env), bins=4, low=-1, high=1)


def in_time(kind):
    return lambda: TimeLimit(kind(), 10)


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    """Checks of a model take many steps, and are kept."""
    monkeypatch.setattr(model_checks, "N_STEPS", 5_000)
    monkeypatch.setattr(model_checks, "_checks", {})


def two(first, second):
    return lambda: DummyVecEnv([first, second])


def make_lake(**kwargs):
    return gym.make("FrozenLake-v1", **kwargs)


def house():
    return gym.make("Warehouse-v0")


def changed_house():
    env = house()
    env.unwrapped.dynamics.edge = Tile(-3, blocked=True)
    return env


STATISTICS = gym.wrappers.RecordEpisodeStatistics
CALM = in_time(partial(Corridor, outcomes(wind=0.0)))
INTERPRETED = {  # reason: environment, settings, callback
    "SubprocVecEnv is not DummyVecEnv": (
        partial(lake, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "fork"}),
    ),
    "VecNormalize is not DummyVecEnv": (lambda: VecNormalize(lake(), norm_obs=False),),
    "the environment's transition model is not known": (partial(lake, wrapper_class=Foreign),),
    "transition model is not known": (in_time(partial(with_p, None)),),
    "rewards are drawn, and the environment's model holds": (
        partial(gym.make, "MaximizationBias-v0"),
    ),
    "the environments are not alike": (two(make_lake, partial(make_lake, is_slippery=False)),),
    "environments are not alike": (two(pole, partial(pole, gravity=1.6)),),
    "are not alike": (two(make_lake, lambda: Monitor(make_lake())),),
    "the environments are not alike$": (two(house, changed_house),),
    "Monitor records further keys": (partial(lake, monitor_kwargs={"info_keywords": ("prob",)}),),
    "a time limit lies outside Monitor": (
        partial(lake, wrapper_class=partial(TimeLimit, max_episode_steps=9)),
    ),
    "model is not known": (
        partial(lake, wrapper_class=partial(TerminationReward, reward=0.0, on_truncation=True)),
    ),
    "more than one Monitor": (partial(lake, wrapper_class=Monitor),),
    "RecordEpisodeStatistics must see every step": (partial(lake, wrapper_class=STATISTICS),),
    "RecordEpisodeStatistics, RenderCollection must see every step": (
        partial(
            lake,
            env_kwargs={"render_mode": "ansi"},
            wrapper_class=lambda env: gym.wrappers.RenderCollection(STATISTICS(env)),
        ),
    ),
    "the environment is shown on the screen": (partial(lake, env_kwargs={"render_mode": "human"}),),
    "under DiscretizeObservation and Monitor alone": (partial(pole, gym.wrappers.Autoreset),),
    "with its default reward alone": (partial(pole, sutton_barto_reward=True),),
    "does not go on from where its attribute s is set": (in_time(Deaf),),
    "the environment's P is not what step does: state ": (CALM,),
    "schedule is a Python function": (lake, {"learning_rate": lambda progress: 0.1 * progress}),
    "a schedule is a Python function": (
        lake,
        {"exploration": "boltzmann", "temperature": lambda progress: 1 + progress},
    ),
    "Curious must be asked after each step": (lake, {}, Curious),
    "ConvertCallback must be asked after each step": (lake, {}, lambda: lambda local, _: True),
    "LoudCheckpoint must be asked": (lake, {}, partial(LoudCheckpoint, 5, "nowhere")),
    "Curious must be asked after each step$": (
        lake,
        {},
        lambda: [CallbackList([Curious()]), StopTrainingOnMaxEpisodes(5)],
    ),
}


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
    assert reason.rstrip("$") in model.engine_in_use
    env.close()


class Steeper(MountainCarEnv):
    pass


LIMITED = "episodes are kept, and there is no limit to their length"
OTHERS = [
    ("reinforce", partial(gym.make, "ShortCorridor-v0", max_episode_steps=-1), LIMITED),
    ("semi_gradient_q", in_time(Steeper), "MountainCar compiles as it is, under Monitor alone"),
]


@pytest.mark.parametrize(("name", "make_env", "reason"), OTHERS, ids=["episodes", "own car"])
def test_what_else_is_interpreted_and_why(name, make_env, reason):
    model = load_algorithm(name)(env=make_env(), seed=0).learn(200)
    assert model.engine_in_use == f"interpreted: {reason}"


def test_the_engine_that_was_asked_for():
    model = load_algorithm("qlearning")(env="FrozenLake-v1")
    in_use = []
    for engine in ("interpreted", "auto", "compiled"):
        model.engine = engine
        in_use.append(model.learn(10).engine_in_use)
    assert in_use == ["interpreted: asked for", "compiled", "compiled"]
    plain = Curious()
    model.learn(1_000, callback=EveryNTimesteps(100, plain))
    assert (model.engine_in_use, plain.seen) == ("compiled", 10)


@pytest.mark.parametrize("engine", ["interpreted", "compiled"])
def test_a_training_of_no_steps(engine):
    model = load_algorithm("sarsa")(env="FrozenLake-v1", engine=engine, seed=0).learn(0)
    assert (model.num_timesteps, model._current_progress_remaining) == (0, 1.0)
    model.learn(99)
    states = []
    for _ in range(2):
        generator = model.env.envs[0].unwrapped.np_random
        pending = model._last_obs.tolist(), model._next_actions.tolist()
        states.append((pending, model.num_timesteps, generator.bit_generator.state))
        model.learn(0, reset_num_timesteps=False)
    assert states[0] == states[1]


# --- environments of one's own -------------------------------------------------------------------


def blown(kind, engine, **settings):
    model = load_algorithm("qlearning")(
        env=in_time(kind)(), engine=engine, seed=4, exploration_final_eps=1.0, **settings
    )
    return model.learn(8_000)


def test_an_environment_of_ones_own_ends_in_the_same_bits():
    models = [blown(Wind, engine) for engine in ("interpreted", "auto")]
    assert models[1].engine_in_use == "compiled"
    np.testing.assert_array_equal(*(model.policy.q_table for model in models))


def test_one_that_draws_in_its_own_way_is_equal_in_distribution():
    """With averages and no discount each value is the mean of some 1,300 rewards."""
    expected = transition_model(OwnWay()).expected_reward
    deviation = np.sqrt(0.7 * 0.3) * (1 + np.arange(3)[:, None] + 2 * np.arange(2))
    words = {
        "auto": "interpreted: the environment draws in its own way, so that compiled training is "
        "equal in distribution only (engine: compiled takes that)",
        "compiled": "compiled, not bit for bit: the environment draws in its own way",
    }
    tables = []
    for engine, said in words.items():
        model = blown(OwnWay, engine, gamma=0.0, learning_rate="sample_average")
        assert model.engine_in_use == said
        tables.append(np.asarray(model.policy.q_table))
        # Five standard errors: of six values one is further off in 1 of 300,000 trainings.
        assert (np.abs(tables[-1] - expected) < 5 * deviation / np.sqrt(1_000)).all()
    assert not np.array_equal(*tables)


def test_one_that_steps_otherwise_is_not_planned_for():
    with pytest.raises(ValueError, match="whose transition model is known: the environment's P is"):
        load_algorithm("value_iteration")(env=CALM()).learn(10)


class Liar(gym.Env):
    """Shows what is not in its space, at the start or after a step."""

    observation_space, action_space = spaces.Discrete(4), spaces.Discrete(2)

    def __init__(self, at_start=0, after_step=0):
        self.at_start, self.after_step = at_start, after_step

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.at_start, {}

    def step(self, action):
        return self.after_step, 1.0, False, False, {}


@pytest.mark.parametrize("name", ["qlearning", "double_qlearning", "epsilon_greedy"])
def test_an_observation_outside_of_the_space_is_refused(name):
    """Compiled code would read and write beside the table."""
    for outside in (4, 10**9, -1):
        for shown in ((outside, 0), (0, outside)):
            model = load_algorithm(name)(env=Liar(*shown), seed=0)
            with pytest.raises(ValueError, match=rf"{outside} is not in Discrete\(4\)"):
                model.learn(5)


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("name", ["qlearning", "semi_gradient_q", "optimal"])
def test_predict_refuses_what_is_not_in_the_space(name, deterministic):
    """A negative number would be looked up from the table's end, and a fraction cut off."""
    model = load_algorithm(name)(env=Liar(), seed=0)
    for outside in (4, -1, 1.5, float("nan"), float("inf")):
        for obs in (outside, np.array([0, outside])):
            with pytest.raises(ValueError, match=rf"{outside} is not in Discrete\(4\)"):
                model.predict(obs, deterministic=deterministic)
    if name != "optimal":
        with pytest.raises(ValueError, match=r"Unexpected observation shape \(2, 2\)"):
            model.predict(np.zeros((2, 2), dtype=np.int64), deterministic=deterministic)


# --- agents of one's own -------------------------------------------------------------------------


class OwnLearning(load_algorithm("qlearning")):
    def _learn_from(self, transitions):
        pass


class Partial(load_algorithm("qlearning")):
    _learn_from = functools.partialmethod(lambda self, transitions: None)


class Moving(load_algorithm("qlearning")):
    gamma = property(lambda self: 0.5, lambda self, value: None)


class Described(load_algorithm("qlearning")):
    def __repr__(self):
        return "a name of its own"


class First:
    def __init__(self, *, first=1, **kwargs):
        super().__init__(**kwargs)
        self.first = first


class Mixed(First, load_algorithm("qlearning")):
    pass


@pytest.mark.parametrize(
    ("kind", "own"), [(OwnLearning, "_learn_from"), (Partial, "_learn_from"), (Moving, "gamma")]
)
def test_what_python_does_instead_is_not_compiled_away(kind, own):
    model = kind(env="FrozenLake-v1", seed=0).learn(100)
    reason = f"{kind.__name__} has a {own} of its own in Python"
    assert model.engine_in_use == f"interpreted: {reason}"
    assert model.policy.visit_counts.any() == (own == "gamma")


def test_what_has_nothing_to_do_with_training_keeps_nothing_from_compiling():
    assert Described(env="FrozenLake-v1", seed=0).learn(100).engine_in_use == "compiled"
    assert {"first", "gamma", "seed"} <= set(Mixed.__signature__.parameters)
    model = Mixed(env="FrozenLake-v1", first=3, gamma=0.5, seed=0).learn(100)
    assert (model.first, model.gamma, model.engine_in_use) == (3, 0.5, "compiled")
    model._learn_from = lambda transitions: None
    reason = "this agent has a _learn_from of its own in Python"
    assert model.learn(100).engine_in_use == f"interpreted: {reason}"


def test_rules_are_compiled_and_cannot_be_exchanged():
    @inlined
    def another(agent, env, progress, table):
        return 100.0

    with pytest.raises(AttributeError, match=r"QLearning\.next_value is compiled into its loop"):
        load_algorithm("qlearning").next_value = another
    with pytest.raises(TypeError, match=r"Plain.next_value is called by compiled code: put @inl"):

        class Plain(load_algorithm("qlearning")):
            def next_value(agent, env, progress, table):  # noqa: N805
                return 0.0


def test_exploring_draws_from_a_generator_that_is_alive():
    """The schedule seeds the agent anew while an action is being chosen."""
    model = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0, exploration="boltzmann")
    model.exploration_schedule = lambda _: (model.set_random_seed(5), 1.0)[1]
    model.set_random_seed(5)
    choices = [model.predict(np.zeros(9, int), deterministic=False)[0].tolist() for _ in range(20)]
    assert choices == [choices[0]] * 20

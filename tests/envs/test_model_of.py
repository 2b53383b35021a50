"""The models that `model_of` finds, against published models and figures known by other means."""

import importlib
import random
import re
import sys
import types
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import rl_yardstick.envs
from rl_yardstick.envs.known_models import observations_of_states, transition_model
from rl_yardstick.envs.model_of import FoundModel, NotFinite, model_of
from rl_yardstick.envs.model_of.check import refutation
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
    assert found.notes == ["712 states stand behind 400 observations, so agents may return less"]


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
        distance = np.linalg.norm(self.agent - self.target, ord=1)
        return {"agent": self.agent, "target": self.target}, {"distance": distance}

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
        board = self.board.tolist()
        return any(board[i] == board[j] == board[k] == player for i, j, k in self.LINES)

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


OWN = ["Warehouse-v0", "DynaMaze-v0", "WindyGridworld-v0", "RiverSwim-v0", "DeepSea-v0"]


@pytest.mark.parametrize("name", OWN)
def test_environments_of_this_project(name: str) -> None:
    env = gym.make(name)
    same_model(model_of(env, **PATIENT), transition_model(env), observations_of_states(env))


class World(gym.Env):
    """A world of one number, made of a rule for its step; the reset sets the number to 0."""

    def __init__(self, rule: Callable[..., Any], states: int = 50, actions: int = 2) -> None:
        self.rule = rule
        self.observation_space = spaces.Discrete(states)
        self.action_space = spaces.Discrete(actions)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x, self.time, self.total = 0, 0, 0.0
        return self.x, {}

    def step(self, action: int) -> Any:
        self.time += 1
        reward, terminated, truncated = self.rule(self, self.np_random, action)
        self.total += reward
        return self.x, reward, terminated, truncated, {"total": self.total}


def truncated_normal(rng: np.random.Generator) -> float:
    return float(round(max(rng.normal(1.0, 2.0), 0.0)) == 0)


DRAWS: dict[str, tuple[Callable[[Any], Any], float]] = {
    "u < 0.3": (lambda rng: float(rng.random() < 0.3), 0.3),
    "a narrow interval": (lambda rng: float(0.123 < rng.random() < 0.12301), 1e-5),
    "int(6 * u)": (lambda rng: int(6 * rng.random()), 2.5),
    "searchsorted": (lambda rng: np.searchsorted([0.1, 0.6, 1.0], rng.random()), 0.5 + 2 * 0.4),
    "argmax": (lambda rng: np.argmax(np.array([0.1, 0.6, 1.0]) > rng.random()), 0.5 + 2 * 0.4),
    "round(normal)": (lambda rng: float(round(rng.normal(1.0, 2.0)) == 1), 0.19741265136584744),
    "max(normal, 0)": (truncated_normal, 0.4012936743170763),
    "a Gaussian reward": (lambda rng: 2 * rng.normal(1.0, 3.0) + 1, 3.0),
    "a Gaussian reward as a float": (lambda rng: 5 - float(rng.normal(1.0, 3.0)), 4.0),
    "min(poisson, 1)": (lambda rng: min(rng.poisson(2.0), 1), 1 - np.exp(-2)),
    "binomial": (lambda rng: float(rng.binomial(10, 0.3) == 4), 210 * 0.3**4 * 0.7**6),
    "choice with chances": (lambda rng: rng.choice([5.0, 7.0], p=[0.25, 0.75]), 6.5),
    "two of four": (lambda rng: sum(rng.choice(4, 2, replace=False)), 3.0),
    "two dice": (lambda rng: float(sum(rng.integers(1, 7) for _ in range(2)) == 7), 1 / 6),
    "until a six": (lambda rng: float(any(rng.integers(6) == 5 for _ in iter(int, 1))), 1.0),
    "Python's choice": (lambda rng: random.choice([1.0, 1.0, 4.0]), 2.0),  # noqa: S311
    "the global generator": (lambda rng: np.random.randint(1, 3), 1.5),  # noqa: NPY002
    "shuffled": (lambda rng: float(rng.permutation(4)[0]), 1.5),
}


def test_draws() -> None:
    """Each action is one of the draws, and its value the reward of an episode of one step."""
    rules = [draw for draw, _ in DRAWS.values()]
    world = World(
        lambda _, rng, action: (rules[action.item()](rng), True, False), actions=len(rules)
    )
    found = model_of(world, **PATIENT)
    assert found.model.n_states == 1
    means = dict(zip(DRAWS, found.model.expected_reward[0], strict=True))
    assert means == pytest.approx({name: mean for name, (_, mean) in DRAWS.items()}, abs=1e-12)
    noise = dict(zip(DRAWS, found.model.reward_variance[0].max(axis=1), strict=True))
    variances = {"a Gaussian reward": 36.0, "a Gaussian reward as a float": 9.0}
    assert {name: x for name, x in noise.items() if x > 0} == pytest.approx(variances)


def walk(world: Any, rng: Any, action: int) -> Any:
    world.x = min(max(world.x + (1 if rng.random() < (0.9, 0.2)[action] else -1), 0), 9)
    return float(world.x), False, world.time >= 30


def bonus(world: Any, rng: Any, action: int) -> Any:
    """The reward of the goal falls with the time."""
    world.x = min(max(world.x + 2 * action - 1, 0), 3)
    return (1 - 0.01 * world.time) * (world.x == 3), world.x == 3, world.time >= 30


def test_a_counter_of_steps_is_no_state() -> None:
    found = model_of(World(walk), **PATIENT)
    assert (found.model.n_states, found.horizon) == (10, 30)
    assert found.notes == ["`time` counts the steps: episodes end after 30"]


def test_a_counter_that_rewards_depend_on() -> None:
    found = model_of(World(bonus), **PATIENT)
    assert (found.model.n_states, found.horizon, len(found.observations)) == (90, 30, 90)
    assert optimum(found) == pytest.approx(0.97, abs=1e-12)


def first_hit(world: Any, rng: Any, action: int) -> Any:
    """Remembers when the action was 1 for the first time, and pays that."""
    world.x = world.x or action * world.time
    return float(world.x) * (world.time >= 4), False, world.time >= 4


def first_hit_at_end(world: Any, rng: Any, action: int) -> Any:
    reward, _, is_over = first_hit(world, rng, action)
    return reward, is_over, False


def closed(world: Any, rng: Any, action: int) -> Any:
    """Nothing may be asked of it after its end."""
    return [1.0, 2.0, 3.0, 4.0][world.time - 1] * action, world.time == 4, False


TIMES = {"a copy": (first_hit, 4.0), "a copy at the end": (first_hit_at_end, 4.0)}
TIMES |= {"no step after the end": (closed, 10.0)}


@pytest.mark.parametrize("name", TIMES)
def test_a_counter_that_is_read(name: str) -> None:
    rule, best = TIMES[name]
    assert optimum(model_of(World(rule), **PATIENT), 100) == pytest.approx(best, abs=1e-12)


class Around(gym.Env):
    """Holds another environment, which it seeds."""

    def __init__(self) -> None:
        self.inner = gym.make("FrozenLake-v1", is_slippery=False).unwrapped
        self.action_space, self.observation_space = spaces.Discrete(4), spaces.Discrete(16)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.inner.reset(seed=seed)

    def step(self, action: int) -> Any:
        return self.inner.step(action)


def test_an_inner_environment_and_its_seed() -> None:
    assert optimum(model_of(Around(), **PATIENT), 100) == pytest.approx(1.0, abs=1e-12)


def climb(world: Any, rng: Any, action: int) -> Any:
    world.x += action
    return 0.0, False, False


def drift(world: Any, rng: Any, action: int) -> Any:
    world.x += rng.normal()
    return 0.0, False, False


def unpicklable(world: Any, rng: Any, action: int) -> Any:
    world.stream = getattr(world, "stream", None) or iter(x for x in range(9))
    world.x = next(world.stream) % 3
    return 0.0, world.x == 2, False


def shuffled(world: Any, rng: Any, action: int) -> Any:
    rng.shuffle(list(range(52)))
    return 0.0, True, False


class Hidden:
    steps = 0


def hidden(world: Any, rng: Any, action: int) -> Any:
    Hidden.steps += 1
    return float(Hidden.steps % 7 == 0), Hidden.steps % 5 == 0, False


def endless(world: Any, rng: Any, action: int) -> Any:
    world.x = rng.integers(5) + rng.integers(9000) + rng.integers(9000)
    return 0.0, False, False


REFUSALS: dict[str, tuple[Callable[..., Any], str]] = {
    "continuous": (drift, r"test_model_of.py:\d+ draws a continuous number, which reaches the st"),
    "too many states": (climb, r"more than 1,000 states; `x` has \d+ values in \d+ of them"),
    "not saved": (unpicklable, r"`stream` cannot be saved: cannot pickle 'generator' object"),
    "orders": (shuffled, r"test_model_of.py:\d+ shuffles 52 things: too many orders"),
    "outside": (hidden, r"something outside its attributes decides .*: state 0, action "),
    "no end": (endless, r"no end after 2 seconds: a step has more than \d+,?\d* outcomes"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_refusals(name: str) -> None:
    rule, message = REFUSALS[name]
    seconds, most = (2.0, 10**6) if name == "no end" else (100.0, 1000)
    with pytest.raises(NotFinite, match=message):
        model_of(World(rule), seconds=seconds, max_states=most)


class Record(World):
    """Keeps its best position over the reset."""

    best = 0

    def step(self, action: int) -> Any:
        self.x = self.best = max(self.best, action)
        return self.x, 0.0, action == 0, False, {}


def test_what_is_kept_over_the_reset_is_named() -> None:
    env = Record(climb)
    env.best = 0
    with pytest.raises(NotFinite, match="`best` is kept over `reset`"):
        model_of(env, **PATIENT)


class Treasures(World):
    """Each place pays once, and never again in later episodes."""

    def __init__(self) -> None:
        super().__init__(climb)
        self.taken: set[int] = set()

    def step(self, action: int) -> Any:
        self.x += 1 + action
        is_new = self.x not in self.taken
        self.taken.add(self.x)
        return self.x, float(is_new), self.x >= 5, False, {}


def test_what_the_first_episodes_use_up_is_named() -> None:
    with pytest.raises(NotFinite, match="`taken` is kept over `reset`"):
        model_of(Treasures(), **PATIENT)


class Deal(World):
    """A reset deals nine cards; a step plays one, which is right or wrong by chance."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.hand = self.np_random.integers(0, 30, size=9).tolist()
        return self.hand[-1], {}

    def step(self, action: int) -> Any:
        card = self.hand.pop()
        right = bool(self.np_random.random() < (0.8 if (card < 15) == (action == 0) else 0.2))
        return self.hand[-1] if self.hand else 30, float(right), not self.hand, False, {}


def test_seeds_of_resets() -> None:
    """Each seed gives a start; steps stay random. Playing each card well is right in 0.8."""
    with pytest.raises(NotFinite, match=r"more than .* outcomes \(optimum --starts 0 1 2"):
        model_of(Deal(climb), seconds=1.0)
    found = model_of(Deal(climb), starts=[0, 1, 2], **PATIENT)
    assert found.model.initial[found.model.initial > 0] == pytest.approx([1 / 3] * 3)
    assert optimum(found, 9) == pytest.approx(9 * 0.8)


def test_a_helper_module_that_imports_a_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    dice: Any = types.ModuleType(f"{__name__}.dice")
    dice.choice = random.choice
    monkeypatch.setitem(sys.modules, dice.__name__, dice)
    found = model_of(World(lambda *_: (float(dice.choice([1, 1, 4])), True, False)), **PATIENT)
    assert found.model.expected_reward[0] == pytest.approx(2.0)


@pytest.mark.parametrize("shift", [0.1, -0.1])
def test_a_shift_of_ten_percent_is_caught(shift: float) -> None:
    env = gym.make("FrozenLake-v1").unwrapped
    found = model_of(env)
    prob = found.model.prob.copy()
    prob[..., 0] *= np.where(found.model.prob[..., 0] < 1, 1 + shift, 1)
    rest = found.model.prob[..., 1:].sum(axis=2)
    scale = np.divide(1 - prob[..., 0], rest, out=np.ones_like(rest), where=rest > 0)
    prob[..., 1:] *= scale[..., None]
    numbers = {observation: state for state, observation in enumerate(found.observations)}
    for p, refuted in ((found.model.prob, False), (prob, True)):
        model = replace(found.model, prob=p)
        problem = refutation(env, model, lambda shown, _: numbers.get(shown), range(4))
        assert (problem is not None) == refuted


def test_one_impossible_step_refutes() -> None:
    env = gym.make("FrozenLake-v1").unwrapped
    model = transition_model(gym.make("FrozenLake-v1", is_slippery=False))
    problem = refutation(env, model, lambda state, _: state, [0, 1, 2, 3])
    step = r"the model has no step to \d+ with the reward \d, the environment made one"
    assert re.fullmatch(rf"state \d+, action \d: {step}", problem)


def test_the_environment_is_left_as_it_was() -> None:
    env = gym.make("FrozenLake-v1")
    env.reset(seed=3)
    env.step(1)

    def state() -> list[Any]:
        base, rng, time = env.unwrapped, env.np_random, env.get_wrapper_attr("_elapsed_steps")
        return [*map(type, (env, env.env, base)), base.s, time, rng, rng.bit_generator.state]

    before = state()
    model_of(env, **PATIENT)
    assert state() == before
    assert isinstance(env.env.env, gym.Wrapper)
    env.step(0)


@pytest.mark.parametrize(
    ("name", "n_states", "best"),
    [("MiniGrid-Empty-5x5-v0", 32, 0.955), ("MiniGrid-DoorKey-5x5-v0", 1608, 0.9646)],
)
def test_minigrid(name: str, n_states: int, best: float) -> None:
    """Every state but the goal's stands in the model once for each step of the episode."""
    importlib.import_module("minigrid")  # registers its environments
    env = gym.make(name)
    found = model_of(env, **PATIENT)
    assert found.model.n_states == n_states * found.horizon
    assert optimum(found, found.horizon) == pytest.approx(best, abs=1e-4)

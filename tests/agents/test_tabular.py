"""What is particular to the tabular agents: order of events, ends of episodes, options."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from agents import load_algorithm
from agents.tabular.one_step import SARSA, DoubleQLearning, ExpectedSARSA, QLearning

ALL = [QLearning, SARSA, ExpectedSARSA, DoubleQLearning]
GREEDY = {"exploration_decay": "constant", "exploration_initial_eps": 0.0}
UNIFORM = {"exploration_decay": "constant", "exploration_initial_eps": 1.0}


class Corridor(gym.Env):
    """Action 1 moves one cell on and action 0 stays; each step earns the number of the cell."""

    def __init__(self, length=3, ends=True):
        self.observation_space = spaces.Discrete(length + 1)
        self.action_space = spaces.Discrete(2)
        self.length = length
        self.ends = ends

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return self.cell, {}

    def step(self, action):
        self.cell = min(self.cell + int(action), self.length)
        return self.cell, float(self.cell), self.ends and self.cell == self.length, False, {}


class Tracer(BaseCallback):
    def __init__(self):
        super().__init__()
        self.actions = []

    def _on_step(self):
        self.actions.append(int(self.locals["actions"][0]))
        return True


def test_q_learning_two_episodes_by_hand():
    # Greedy with an optimistic 10 for action 1: straight to the end, each time.
    model = QLearning(env=Corridor(), learning_rate=0.5, gamma=0.5, seed=0, **GREEDY)
    model.policy.q_tables[0, :, 1] = 10.0
    model.learn(3)
    # 10 + .5 * (1 + .5 * 10 - 10), 10 + .5 * (2 + .5 * 10 - 10), 10 + .5 * (3 - 10).
    np.testing.assert_allclose(model.policy.q_table[:3, 1], [8.0, 8.5, 6.5])
    model.learn(3, reset_num_timesteps=False)
    np.testing.assert_allclose(
        model.policy.q_table[:3, 1],
        [8 + 0.5 * (1 + 4.25 - 8), 8.5 + 0.5 * (2 + 3.25 - 8.5), 6.5 + 0.5 * (3 - 6.5)],
    )
    np.testing.assert_array_equal(model.policy.visit_counts[0, :, 1], [2, 2, 2, 0])


@pytest.mark.parametrize("algorithm", ALL)
def test_truncation_bootstraps_and_termination_does_not(algorithm):
    def entry(ends):
        env = TimeLimit(Corridor(length=1, ends=ends), 1)
        model = algorithm(env=env, learning_rate=1.0, gamma=0.5, seed=0, **GREEDY)
        model.policy.q_tables[:, 0, 1] = 1.0
        model.policy.q_tables[:, 1, :] = 8.0
        model.learn(1)
        return model.policy.q_tables[:, 0, 1].numpy()

    # The reward is 1 on reaching cell 1: with 0.5 * 8 of bootstrap, or alone. Double Q-learning
    # updates one of its tables.
    assert 5.0 in entry(ends=False)
    assert 5.0 not in entry(ends=True)


@pytest.mark.parametrize("algorithm", ALL)
def test_skipping_the_terminal_update(algorithm):
    env = TimeLimit(Corridor(length=1), 50)
    model = algorithm(env=env, skip_terminal_update=True, seed=0, **UNIFORM).learn(300)
    assert model.policy.visit_counts[:, 0, 1].sum() == 0
    assert model.policy.visit_counts[:, 0, 0].sum() > 0
    assert model.policy.q_tables[:, 0, 1].abs().sum() == 0


def test_sarsa_does_what_it_committed_to():
    # The action that the target used is the one taken next, even where the update made another one
    # better: here every update makes the action that was just taken the worst.
    committed = []

    class Recorder(SARSA):
        def _learn_from(self, transitions):
            super()._learn_from(transitions)
            committed.append((int(self._next_actions[0]), bool(transitions.dones[0])))

    tracer = Tracer()
    Recorder(env=Corridor(length=30), learning_rate=1.0, seed=0, **UNIFORM).learn(
        300, callback=tracer
    )
    followed = [
        action == taken
        for (action, done), taken in zip(committed, tracer.actions[1:], strict=False)
        if not done
    ]
    assert len(followed) > 200
    assert all(followed)


def test_q_learning_chooses_after_the_update():
    # One state, two actions that both earn nothing but cost value: greedy alternates.
    env = TimeLimit(Corridor(length=3, ends=False), 1000)
    model = QLearning(
        env=env, learning_rate=0.5, gamma=0.0, initial_q=1.0, tie_breaking="first", seed=0, **GREEDY
    )
    tracer = Tracer()
    model.learn(2, callback=tracer)
    # Action 0 earns 0 in cell 0, so that its value falls below that of action 1.
    assert tracer.actions == [0, 1]


def test_ties():
    def first_actions(tie_breaking):
        model = QLearning(
            env=Corridor(length=50),
            learning_rate=0.0,
            tie_breaking=tie_breaking,
            seed=0,
            **GREEDY,
        )
        tracer = Tracer()
        model.learn(40, callback=tracer)
        return set(tracer.actions)

    assert first_actions("first") == {0}
    assert first_actions("random") == {0, 1}


@pytest.mark.parametrize(
    ("arguments", "rates"),
    [
        ({"exploration_decay": "constant", "exploration_initial_eps": 0.3}, [0.3, 0.3, 0.3]),
        (
            {"exploration_initial_eps": 1.0, "exploration_final_eps": 0.2},
            [1.0, 0.2, 0.2],
        ),
        (
            {"exploration_fraction": 1.0, "exploration_final_eps": 0.0},
            [1.0, 0.5, 0.0],
        ),
        (
            {
                "exploration_decay": "exponential",
                "exploration_fraction": 1.0,
                "exploration_initial_eps": 0.9,
                "exploration_final_eps": 0.1,
            },
            [0.9, 0.3, 0.1],
        ),
        ({"exploration": "boltzmann", "temperature": 2.5}, [2.5, 2.5, 2.5]),
        ({"exploration": "gaussian_noise", "noise_std": 3.0}, [3.0, 3.0, 3.0]),
    ],
)
def test_exploration_schedules(arguments, rates):
    model = QLearning(env="FrozenLake-v1", **arguments)
    measured = []
    for progress_remaining in (1.0, 0.5, 0.0):
        model._current_progress_remaining = progress_remaining
        measured.append(model.exploration_rate)
    assert measured == pytest.approx(rates)


def test_gaussian_noise_falls_by_the_episode():
    model = QLearning(env="FrozenLake-v1", exploration="gaussian_noise", noise_std=2.0)
    model._episode_num = 3
    assert model.exploration_rate == 0.5


def test_initial_tables():
    constant = QLearning(env="FrozenLake-v1", initial_q=5.0)
    assert (constant.policy.q_table == 5).all()
    random = QLearning(env="Taxi-v4", initial_q=5.0, initial_q_std=2.0, seed=0)
    # 3000 entries: mean and standard deviation within four standard errors.
    assert random.policy.q_table.mean() == pytest.approx(5, abs=4 * 2 / 3000**0.5)
    assert random.policy.q_table.std() == pytest.approx(2, abs=4 * 2 / 6000**0.5)


@pytest.mark.parametrize("algorithm", ALL)
@pytest.mark.parametrize("exploration", ["epsilon_greedy", "boltzmann", "gaussian_noise"])
@pytest.mark.parametrize("learning_rate", [0.1, "sample_average"])
def test_every_combination_trains(algorithm, exploration, learning_rate):
    if algorithm is ExpectedSARSA and exploration == "gaussian_noise":
        with pytest.raises(ValueError, match="take epsilon_greedy or boltzmann"):
            algorithm(env="FrozenLake-v1", exploration=exploration)
        return
    model = algorithm(
        env="FrozenLake-v1", exploration=exploration, learning_rate=learning_rate, seed=0
    ).learn(300)
    assert int(model.policy.visit_counts.sum()) == 300


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"gamma": 1.5}, "gamma must lie between 0 and 1"),
        (
            {"initial_q_std": 1e308, "seed": 0},  # one of the numbers that are drawn is above 1.8
            "initial_q and initial_q_std must give finite values, not 0 and 1",
        ),
        ({"exploration": "greedy"}, "exploration must be one of epsilon_greedy"),
        ({"tie_breaking": "last"}, "tie_breaking must be one of random, first"),
        ({"exploration_decay": "cosine"}, "exploration_decay must be one of"),
        ({"learning_rate": "average"}, "learning_rate must be a number"),
        ({"learning_rate": -0.1}, "learning_rate must be at least 0, not -0.1"),
        ({"learning_rate": float("nan")}, "learning_rate must be at least 0, not nan"),
        ({"learning_rate": float("inf")}, "learning_rate must be finite, not inf"),
        ({"exploration": "boltzmann", "temperature": 0.0}, "temperature must be above 0"),
        (
            {"exploration_decay": "exponential", "exploration_final_eps": 0.0},
            "start and end above 0",
        ),
        ({"env": "CartPole-v1"}, "Discrete space that starts at 0"),
        ({"env": "MountainCarContinuous-v0"}, "Discrete space that starts at 0"),
    ],
)
def test_wrong_arguments(arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        QLearning(**{"env": "FrozenLake-v1", **arguments})


def test_every_name_in_the_table_can_be_loaded():
    assert load_algorithm("qlearning") is QLearning
    assert load_algorithm("double_qlearning") is DoubleQLearning


class Liar(gym.Env):
    """Shows what is not in its space, at the start or after a step."""

    observation_space = spaces.Discrete(4)
    action_space = spaces.Discrete(2)

    def __init__(self, at_start, after_step):
        self.at_start, self.after_step = at_start, after_step

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.at_start, {}

    def step(self, action):
        return self.after_step, 1.0, False, False, {}


@pytest.mark.parametrize("outside", [4, 10**9, -1])
@pytest.mark.parametrize("name", ["qlearning", "double_qlearning", "epsilon_greedy"])
def test_an_observation_outside_of_the_space_is_refused(name, outside):
    """Compiled code would read and write beside the table."""
    for at_start, after_step in ((outside, 0), (0, outside)):
        model = load_algorithm(name)(env=Liar(at_start, after_step), seed=0)
        with pytest.raises(ValueError, match=rf"{outside} is not in Discrete\(4\)"):
            model.learn(5)
    with pytest.raises(ValueError, match=rf"{outside} is not in Discrete\(4\)"):
        load_algorithm(name)(env=Liar(0, 0), seed=0).predict(outside, deterministic=False)


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("outside", [4, -1, 1.5, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["qlearning", "semi_gradient_q", "optimal"])
def test_predict_refuses_what_is_not_in_the_space(name, outside, deterministic):
    """A negative number would be looked up from the table's end, and a fraction cut off."""
    model = load_algorithm(name)(env=Liar(0, 0), seed=0)
    for obs in (outside, np.array([0, outside])):
        with pytest.raises(ValueError, match=rf"{outside} is not in Discrete\(4\)"):
            model.predict(obs, deterministic=deterministic)


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("name", ["qlearning", "semi_gradient_q"])
def test_predict_takes_one_observation_or_a_row_of_them(name, deterministic):
    model = load_algorithm(name)(env=Liar(0, 0), seed=0)
    with pytest.raises(ValueError, match=r"Unexpected observation shape \(2, 2\)"):
        model.predict(np.zeros((2, 2), dtype=np.int64), deterministic=deterministic)


@pytest.mark.parametrize("engine", ["compiled", "interpreted"])
def test_a_temperature_may_fall_to_0(engine):
    schedule = LinearSchedule(1.0, 0.0, 1.0)
    model = load_algorithm("expected_sarsa")(
        env="FrozenLake-v1", exploration="boltzmann", temperature=schedule, seed=0, engine=engine
    ).learn(200)
    assert model.exploration_rate == 0.0
    assert np.isfinite(model.policy.q_table).all()
    np.testing.assert_allclose(model.action_probabilities().sum(axis=1), 1.0)

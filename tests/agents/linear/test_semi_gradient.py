"""Semi-gradient control: updates by hand, a table as its special case, both engines to the bit."""

import copy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.common.algorithm import Transitions

NAMES = ("semi_gradient_sarsa", "semi_gradient_q")
SWING = {"low": [-2.4, -3, -0.21, -3], "high": [2.4, 3, 0.21, 3], "n_tiles": [2, 3, 6, 6]}


class Line(gym.Env):
    """Spaces alone; nothing here is ever stepped."""

    observation_space = spaces.Box(0.0, 4.0, (1,))
    action_space = spaces.Discrete(2)


def updated(name, *, terminated=False):
    """What one update changes: from 0.25 to 2.25 by action 1, reward 2, gamma .5, step size .2.

    Two tilings of two tiles (three, as they are displaced by half a tile, which is 1). At 0.25
    tiles 0 and 3 are active, at 2.25 tiles 1 and 4. There, the actions are worth 3 + 1 and 5 + 1;
    at 0.25 action 1 is worth 1 + 2.
    """
    greedy = {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}
    model = load_algorithm(name)(
        env=Line(), n_tilings=2, n_tiles=2, gamma=0.5, learning_rate=0.2, seed=0, **greedy
    )
    weights = model.policy.weights.numpy()
    weights[0], weights[3], weights[1], weights[4] = (0, 1), (0, 2), (3, 5), (1, 1)
    before = weights.copy()
    obs, action, ends = np.array([[0.25]], "f4"), np.array([1]), np.array([terminated])
    model._last_obs, model._next_actions = obs, np.array([-1])
    next_obs = np.array([[2.25]], "f4")
    model._learn_from(Transitions(obs, action, np.array([2.0]), ends, ends, next_obs))
    return weights - before, model


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("terminated", "target"), [(False, 2 + 0.5 * 6), (True, 2.0)])
def test_an_update_by_hand(name, terminated, target):
    change, model = updated(name, terminated=terminated)
    # The step size is shared out between the two tilings.
    assert change[[0, 3], 1] == pytest.approx([0.1 * (target - 3)] * 2, rel=1e-14)
    assert np.count_nonzero(change) == 2
    assert model.mean_td_error == pytest.approx(abs(target - 3))


def test_sarsa_commits_to_its_next_action_and_uses_it():
    _, sarsa = updated("semi_gradient_sarsa")
    assert sarsa._next_actions.tolist() == [1]
    _, ended = updated("semi_gradient_sarsa", terminated=True)
    _, other = updated("semi_gradient_q")
    assert ended._next_actions.tolist() == other._next_actions.tolist() == [-1]
    explorer = load_algorithm("semi_gradient_sarsa")(
        env=Line(), gamma=0.5, learning_rate=1.0, n_tilings=1, n_tiles=2, seed=0
    )
    weights = explorer.policy.weights.numpy()
    weights[1] = 4, 6
    obs, next_obs, no = np.array([[0.25]], "f4"), np.array([[2.25]], "f4"), np.array([False])
    chosen = set()
    for _ in range(20):  # epsilon is 1
        weights[0] = 0
        explorer._next_actions = np.array([-1])
        explorer._learn_from(Transitions(obs, np.array([0]), np.array([2.0]), no, no, next_obs))
        (action,) = explorer._next_actions
        assert weights[0, 0] == 2 + 0.5 * weights[1, action]
        chosen.add(action)
    assert chosen == {0, 1}


def test_values_begin_where_they_are_told_to():
    model = load_algorithm("semi_gradient_q")(env=Line(), initial_q=3.0, n_tilings=4)
    np.testing.assert_allclose(model.policy.sums(np.array([[0.1], [3.9]])), 3.0, rtol=1e-15)
    with pytest.raises(ValueError, match="initial_q must be finite, not inf"):
        load_algorithm("semi_gradient_q")(env=Line(), initial_q=np.inf)


@pytest.mark.parametrize("engine", ["interpreted", "compiled"])
@pytest.mark.parametrize(
    "pair", [("semi_gradient_sarsa", "sarsa"), ("semi_gradient_q", "qlearning")]
)
def test_on_numbers_it_is_the_tabular_rule_to_the_bit(pair, engine):
    models = []
    for name in pair:
        env = make_vec_env("FrozenLake-v1", 3, seed=2)
        settings = {"gamma": 0.97, "learning_rate": LinearSchedule(0.5, 0.1, 0.9)}
        models.append(load_algorithm(name)(env=env, seed=1, engine=engine, **settings))
    tiled, table = models
    tiled.rng = copy.deepcopy(table.rng)  # of which the table has drawn its first entries
    for model in models:
        model.learn(4000)
        assert model.engine_in_use.startswith(engine)
    assert tiled.policy.weights.numpy().any()
    assert np.array_equal(tiled.policy.weights.numpy(), table.policy.q_table)
    assert tiled.rng.bit_generator.state == table.rng.bit_generator.state
    assert tiled.mean_td_error == table.mean_td_error
    assert tiled.predict(np.arange(16), deterministic=True)[0].tolist() == (
        table.predict(np.arange(16), deterministic=True)[0].tolist()
    )
    np.testing.assert_array_equal(tiled.action_probabilities(), table.action_probabilities())


# --- engines -------------------------------------------------------------------------------------

WORLDS = {
    "MountainCar": ("MountainCar-v0", {}),
    "CartPole": ("CartPole-v1", SWING),
}


def state_of(model):
    state = {
        "weights": model.policy.weights.numpy().tobytes(),
        "values": model.policy.state_weights.numpy().tobytes(),
        "generator": model.rng.bit_generator.state,
        "observations": np.asarray(model._last_obs).tolist(),
        "pending actions": model._next_actions.tolist(),
        "counts": (model.num_timesteps, model._episode_num, model._n_updates),
        "error": model.mean_td_error,
        "returns": [(info["r"], info["l"]) for info in model.ep_info_buffer],
    }
    for i, env in enumerate(model.env.envs):
        base = env.unwrapped
        state[f"env {i}"] = (
            base.np_random.bit_generator.state,
            np.asarray(getattr(base, "state", getattr(base, "s", None))).tolist(),
            env.get_wrapper_attr("_elapsed_steps"),
            env.get_wrapper_attr("rewards"),
        )
    return state


@pytest.mark.parametrize(
    ("world", "name", "n_envs"),
    [
        ("MountainCar", "semi_gradient_sarsa", 2),
        ("CartPole", "semi_gradient_q", 1),
    ],
)
def test_both_engines_end_in_the_same_bits(world, name, n_envs):
    env_id, settings = WORLDS[world]
    states = []
    for engines in (("interpreted",) * 2, ("compiled",) * 2, ("compiled", "interpreted")):
        env = make_vec_env(env_id, n_envs, seed=3)
        model = load_algorithm(name)(env=env, seed=1, learning_rate=0.3, **settings)
        for engine in engines:  # neither call ends where an episode does
            model.engine = engine
            model.learn(1111, reset_num_timesteps=False)
            assert model.engine_in_use.startswith(engine)
        states.append(state_of(model))
    assert states[0]["counts"][1] >= n_envs
    assert states[0] == states[1] == states[2]

"""Policy gradients against exact ones, updates by hand, and both engines to the bit."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.common.algorithm import Transitions
from agents.linear.algorithm import TilePolicy


class Spaces(gym.Env):
    """Spaces alone; nothing here is ever stepped."""

    def __init__(self, observations, n_actions):
        self.observation_space = observations
        self.action_space = spaces.Discrete(n_actions)


def agent_on(name, observations, n_actions=2, **settings):
    model = load_algorithm(name)(env=Spaces(observations, n_actions), seed=0, **settings)
    model._begin_episodes()
    return model


def learn(model, obs, action, reward, next_obs, *, terminated=False, truncated=False):
    """Let the agent learn from one step."""
    ends, done = np.array([terminated]), np.array([terminated or truncated])
    steps = np.array([obs]), np.array([action]), np.array([float(reward)]), ends, done
    model._learn_from(Transitions(*steps, np.array([next_obs])))


def softmax(preferences):
    weights = np.exp(preferences - preferences.max(axis=-1, keepdims=True))
    return weights / weights.sum(axis=-1, keepdims=True)


# --- gradients -----------------------------------------------------------------------------------


def test_a_step_of_one_goes_along_the_gradient_of_the_logarithm():
    """Against central differences; tiles share the step, so that it is a third at each."""
    model = agent_on(
        "reinforce", spaces.Box(0.0, 1.0, (2,)), 3, n_tilings=3, n_tiles=2, learning_rate=1.0
    )
    weights = model.policy.weights.numpy()
    weights[:] = before = np.random.default_rng(0).normal(size=weights.shape)
    obs, action, tiny = np.array([0.3, 0.8], "f4"), 2, 1e-6

    def log_probability():
        return np.log(softmax(model.policy.sums(obs[None])))[0, action]

    gradient = np.zeros_like(weights)
    for place in np.ndindex(*weights.shape):
        weights[place] += tiny
        above = log_probability()
        weights[place] -= 2 * tiny
        gradient[place] = (above - log_probability()) / (2 * tiny)
        weights[place] = before[place]
    before = weights.copy()
    learn(model, obs, action, 1.0, obs, terminated=True)
    np.testing.assert_allclose(weights - before, gradient / 3, atol=1e-9)
    assert np.count_nonzero(np.abs(gradient) > 1e-6) == 3 * 3


class Layers:
    """Three layers of two states, through which an episode goes: no state is met twice."""

    discount = 0.9

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.start = np.array([0.3, 0.7])
        self.prob = rng.dirichlet([1, 1], size=(6, 2))  # of the two states of the next layer
        self.reward = rng.normal(size=(6, 2))
        self.preferences = rng.normal(size=(6, 2))
        self.values = rng.normal(size=6)

    def episodes(self):
        """Every episode: its probability, and its states and actions."""
        policy = softmax(self.preferences)
        for sides in itertools.product((0, 1), repeat=3):
            states = [2 * layer + side for layer, side in enumerate(sides)]
            for actions in itertools.product((0, 1), repeat=3):
                steps = list(zip(states, actions, strict=True))
                prob = self.start[sides[0]] * np.prod([policy[step] for step in steps])
                prob *= np.prod([self.prob[steps[t]][sides[t + 1]] for t in range(2)])
                yield prob, steps

    def gradient(self):
        """By the policy gradient theorem: visits times gradients of pi times action values."""
        policy, q = softmax(self.preferences), np.zeros((6, 2))
        for state in range(5, -1, -1):
            q[state] = self.reward[state]
            if state < 4:
                ahead = slice(2 * (state // 2) + 2, 2 * (state // 2) + 4)
                values = (policy[ahead] * q[ahead]).sum(axis=1)
                q[state] += self.discount * self.prob[state] @ values
        visits = np.zeros(6)
        visits[:2] = self.start
        for state in range(4):
            ahead = slice(2 * (state // 2) + 2, 2 * (state // 2) + 4)
            visits[ahead] += self.discount * visits[state] * (policy[state] @ self.prob[state])
        advantage = q - (policy * q).sum(axis=1, keepdims=True)
        return visits[:, None] * policy * advantage


@pytest.mark.parametrize("baseline", ["none", "value"])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_mean_update_of_all_episodes_is_the_exact_gradient(baseline, seed):
    world, step_size = Layers(seed), 0.25
    model = agent_on(
        "reinforce",
        spaces.Discrete(7),
        gamma=world.discount,
        learning_rate=step_size,
        baseline=baseline,
    )
    mean, total = np.zeros((6, 2)), 0.0
    weights, values = model.policy.weights.numpy(), model.policy.state_weights.numpy()
    for prob, steps in world.episodes():
        weights[:6], values[:6] = world.preferences, world.values[: 6 * len(values)]
        for t, (state, action) in enumerate(steps):
            following = steps[t + 1][0] if t < 2 else 6
            reward = world.reward[state, action]
            learn(model, state, action, reward, following, terminated=t == 2)
        mean += prob * (weights[:6] - world.preferences)
        total += prob
    assert total == pytest.approx(1, rel=1e-12)
    np.testing.assert_allclose(mean / step_size, world.gradient(), atol=1e-12)


# --- by hand -------------------------------------------------------------------------------------


def test_reinforce_by_hand():
    """Rewards 1 and 2, gamma .5: returns 2 and 2; the second counts by a half."""
    for gamma_power, second in ((True, 0.5), (False, 1.0)):
        settings = {"gamma": 0.5, "learning_rate": 0.1, "gamma_power": gamma_power}
        model = agent_on("reinforce", spaces.Discrete(3), **settings)
        learn(model, 0, 1, 1, 1)
        weights = model.policy.weights.numpy()
        assert not weights.any()  # nothing before the end
        learn(model, 1, 0, 2, 2, terminated=True)
        expected = [[-0.1, 0.1], [second * 0.1, -second * 0.1], [0, 0]]
        np.testing.assert_allclose(weights, expected, rtol=1e-14)
        assert model.mean_td_error == 2


def test_where_an_episode_is_truncated_the_baseline_goes_on():
    for baseline, returns in (("none", 2.0), ("value", 2.0 + 0.5 * 6)):
        settings = {"gamma": 0.5, "learning_rate": 0.1, "value_step_size": 0.5}
        model = agent_on("reinforce", spaces.Discrete(3), baseline=baseline, **settings)
        values = model.policy.state_weights.numpy()
        values[:] = np.array([1, 2, 6])[: len(values)]
        learn(model, 1, 0, 2, 2, truncated=True)
        compared = 2 if baseline == "value" else 0
        change = 0.1 * (returns - compared) * 0.5
        np.testing.assert_allclose(model.policy.weights.numpy()[1], [change, -change], rtol=1e-14)
        assert values.tolist() == ([1, 2 + 0.5 * 3, 6] if baseline == "value" else [])


def test_actor_critic_by_hand():
    """TD error 2 + .5 * 4 - 1 = 3; of the second step, 1 + .5 * 0 - 4 = -3, by a half."""
    settings = {"gamma": 0.5, "learning_rate": 0.1, "value_step_size": 0.2}
    for gamma_power, second in ((True, 0.5), (False, 1.0)):
        model = agent_on("actor_critic", spaces.Discrete(3), gamma_power=gamma_power, **settings)
        values, weights = model.policy.state_weights.numpy(), model.policy.weights.numpy()
        values[:] = 1, 4, 0
        learn(model, 0, 1, 2, 1)
        np.testing.assert_allclose(values, [1.6, 4, 0], rtol=1e-14)
        np.testing.assert_allclose(weights, [[-0.15, 0.15], [0, 0], [0, 0]], rtol=1e-14)
        learn(model, 1, 1, 1, 2)
        np.testing.assert_allclose(values, [1.6, 3.4, 0], rtol=1e-14)
        np.testing.assert_allclose(weights[1], [0.15 * second, -0.15 * second], rtol=1e-14)
        # The third step ends it: what follows counts for nothing, whatever it is worth.
        learn(model, 2, 0, 4, 1, terminated=True)
        assert values[2] == pytest.approx(0.8)
        third = 0.1 * 4 * 0.5 * (0.25 if gamma_power else 1)
        np.testing.assert_allclose(weights[2], [third, -third], rtol=1e-14)
        assert model._discounts.tolist() == [1]
        # Truncated, it counts.
        values[:] = 0, 2, 0
        learn(model, 0, 0, 1, 1, truncated=True)
        assert values[0] == pytest.approx(0.2 * (1 + 0.5 * 2))


def test_preferences_begin_where_they_are_told_to():
    model = agent_on("reinforce", spaces.Discrete(2), initial_preferences=[np.log(19), 0])
    np.testing.assert_allclose(model.action_probabilities(), [[0.95, 0.05]] * 2, rtol=1e-12)
    drawn = model.predict(np.zeros(20_000, dtype=int))[0]
    assert drawn.mean() == pytest.approx(0.05, abs=5 * np.sqrt(0.05 * 0.95 / 20_000))
    assert model.predict(np.array([0, 1]), deterministic=True)[0].tolist() == [0, 0]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"initial_preferences": [1, 2, 3]}, "initial_preferences must be a number or 2 numbers"),
        ({"initial_preferences": np.inf}, "initial_preferences must be finite, not inf"),
        ({"baseline": "mean"}, "baseline must be one of none, value, not 'mean'"),
        ({"value_step_size": -1}, "value_step_size must be at least 0, not -1"),
        ({"gamma": 1.1}, "gamma must lie between 0 and 1, not 1.1"),
        ({"learning_rate": "sample_average"}, "learning_rate must be a number or a schedule"),
        ({"engine": "fast"}, "engine must be one of auto, compiled, interpreted, not 'fast'"),
    ],
)
def test_mistakes_are_one_line(settings, message):
    with pytest.raises(ValueError, match=message):
        agent_on("reinforce", spaces.Discrete(2), **settings)


# --- engines -------------------------------------------------------------------------------------


def state_of(model):
    kept = [name for name in ("_lengths", "_discounts") if hasattr(model, name)]
    return {
        "weights": model.policy.weights.numpy().tobytes(),
        "values": model.policy.state_weights.numpy().tobytes(),
        "generator": model.rng.bit_generator.state,
        "kept": [getattr(model, name).tolist() for name in kept],
        "counts": (model.num_timesteps, model._episode_num, model._n_updates),
        "error": model.mean_td_error,
        "returns": [(info["r"], info["l"]) for info in model.ep_info_buffer],
        "environments": [env.unwrapped.np_random.bit_generator.state for env in model.env.envs],
    }


LEFT_AT_FIRST = {"initial_preferences": [1.47, -1.47]}


@pytest.mark.parametrize(
    ("name", "env_id", "settings"),
    [
        ("actor_critic", "FrozenLake-v1", {"gamma": 0.9}),
        # Episodes of 82 steps on average, more than there is room for at first.
        ("reinforce", "ShortCorridor-v0", {**LEFT_AT_FIRST, "learning_rate": 0.002}),
        ("reinforce", "ShortCorridor-v0", {**LEFT_AT_FIRST, "baseline": "value"}),
    ],
)
def test_both_engines_end_in_the_same_bits(name, env_id, settings):
    states = []
    for engines in (("interpreted",) * 2, ("compiled",) * 2, ("compiled", "interpreted")):
        env = make_vec_env(env_id, 2, seed=3)
        model = load_algorithm(name)(env=env, seed=1, **settings)
        for engine in engines:  # neither call ends where an episode does
            model.engine = engine
            model.learn(1311, reset_num_timesteps=False)
            assert model.engine_in_use.startswith(engine)
        states.append(state_of(model))
    assert states[0] == states[1] == states[2]
    assert states[0]["counts"][1] > 5
    assert np.frombuffer(states[0]["weights"]).any()


def test_episodes_without_a_limit_are_interpreted():
    env = gym.make("ShortCorridor-v0", max_episode_steps=-1)
    model = load_algorithm("reinforce")(env=env, seed=0).learn(200)
    assert model.engine_in_use == (
        "interpreted: episodes are kept, and there is no limit to their length"
    )


def test_environments_that_are_wrapped_together_are_interpreted():
    env = VecNormalize(make_vec_env("ShortCorridor-v0", 1, seed=0), norm_obs=False)
    model = load_algorithm("reinforce")(env=env, seed=0).learn(200)
    assert model.engine_in_use == "interpreted: VecNormalize is not DummyVecEnv"


# --- what is learnt, and kept --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("reinforce", {"learning_rate": 2**-11}),
        ("reinforce", {"learning_rate": 2**-9, "baseline": "value", "value_step_size": 2**-6}),
    ],
)
def test_the_corridor_is_learnt_to_be_left_by_chance(name, settings):
    settings = {**LEFT_AT_FIRST, **settings}
    model = load_algorithm(name)(env="ShortCorridor-v0", seed=0, engine="compiled", **settings)
    model.learn(60_000)
    right = model.action_probabilities()[0, 1]
    # Within a tenth of the best, -11.66.
    assert (4 - 2 * right) / (right * (1 - right)) < 1.1 * 11.66


def test_the_corridor_defeats_bootstrapping():
    """Where all states look alike, the TD error says -1 of every step but the last."""
    settings = {"learning_rate": 2**-6, "value_step_size": 2**-4}
    model = load_algorithm("actor_critic")(env="ShortCorridor-v0", seed=0, **settings)
    right = model.learn(60_000).action_probabilities()[0, 1]
    assert (4 - 2 * right) / (right * (1 - right)) > 10 * 11.66


def test_actor_critic_finds_the_way_over_a_lake_that_is_not_slippery():
    env = make_vec_env("FrozenLake-v1", 1, seed=0, env_kwargs={"is_slippery": False})
    model = load_algorithm("actor_critic")(env=env, seed=0, gamma=0.95, learning_rate=0.5)
    model.learn(50_000)
    assert model.engine_in_use == "compiled"
    assert np.mean([episode["r"] for episode in model.ep_info_buffer]) > 0.9


def test_a_policy_file_brings_weights_and_tilings_back(tmp_path):
    model = agent_on(
        "actor_critic",
        spaces.Box(-np.inf, np.inf, (2,)),
        low=[-1, -2],
        high=[1, 2],
        n_tiles=[3, 4],
    )
    model.policy.weights.normal_()
    model.policy.state_weights.normal_()
    model.policy.save(str(tmp_path / "policy.pth"))
    loaded = TilePolicy.load(str(tmp_path / "policy.pth"))
    places = np.random.default_rng(0).uniform(-3, 3, (50, 2)).astype("f4")
    np.testing.assert_array_equal(loaded.sums(places), model.policy.sums(places))
    assert loaded.state_weights.tolist() == model.policy.state_weights.tolist()

"""What ``auto`` stands for in an entry, what wins over an entry, and what a discount costs."""

import gymnasium as gym
import numpy as np
import pytest

from envs.known_models import transition_model
from envs.wrappers import ScaleReward
from pipeline.agent_settings import resolved_spec, training_follows
from pipeline.environments import make_single_env
from pipeline.errors import UserError
from pipeline.evaluation.exact import discount_note, exact_evaluator
from pipeline.settings.hyperparams import read_hyperparams, split

SCALED = {"train_env_wrapper": {"envs.wrappers.ScaleReward": {"scale": "auto"}}}
CLIP = {"gymnasium.wrappers.ClipReward": {"min_reward": "auto"}}
SHORT = {"max_episode_steps": 200}
POOR = {"shelf_reward": -1, "step_reward": -0.01, "goal_reward": 1}


def resolved(env_id, raw, algo="qlearning"):
    return resolved_spec(raw, algo=algo, env_id=env_id, seed=0)


@pytest.mark.parametrize(
    ("env_id", "raw", "key", "value"),
    [
        ("Warehouse-v0", {"gamma": "auto"}, "gamma", 0.9995),
        ("FrozenLake-v1", {"gamma": "auto"}, "gamma", 0.995),
        # Ten times the shortest way of 18 moves.
        ("RandomWarehouse-v0", {"gamma": "auto"}, "gamma", 0.9972222),
        # It has no limit but the one under which it is judged.
        ("CliffWalking-v1", {"gamma": "auto"}, "gamma", 0.9995),
        ("CliffWalking-v1", {"gamma": "auto", "eval_env_kwargs": SHORT}, "gamma", 0.9975),
        ("Warehouse-v0", {"n_timesteps": "auto"}, "n_timesteps", 1_000_000),
        ("Warehouse-v0", {"n_timesteps": "auto_7"}, "n_timesteps", 2800),
        (
            "RandomWarehouse-v0",
            {"n_timesteps": "auto_1000", "env_kwargs": {"size": 30}},
            "n_timesteps",
            3_600_000,
        ),
        ("FrozenLake-v1", {"n_timesteps": "auto_8000"}, "n_timesteps", 800_000),  # 64 pairs
        ("Warehouse-v0", {"learning_rate": "auto", "n_timesteps": "auto"}, "learning_rate", 0.004),
        ("Warehouse-v0", {"learning_rate": "auto", "n_timesteps": 200_000}, "learning_rate", 0.02),
        ("Warehouse-v0", {"learning_rate": "auto", "n_timesteps": 20_000}, "learning_rate", 0.05),
        ("Warehouse-v0", {"learning_rate": "auto", "n_timesteps": 10**7}, "learning_rate", 0.003),
        ("Warehouse-v0", {"learning_rate": "auto", "n_episodes": 10}, "learning_rate", 0.05),
        ("FrozenLake-v1", {"initial_q": "auto"}, "initial_q", 1.0),
        (
            "FrozenLake-v1",
            {"initial_q": "auto", "env_kwargs": {"reward_schedule": (7, -3, 0)}},
            "initial_q",
            7.0,
        ),
        ("Warehouse-v0", {"value_bound": "auto", "env_kwargs": POOR}, "value_bound", 1.0),
        ("Warehouse-v0", SCALED, "scale", 0.01),
        ("Warehouse-v0", {**SCALED, "env_kwargs": POOR}, "scale", 1.0),
        ("Warehouse-v0", {**SCALED, "train_env_kwargs": {"goal_reward": 400}}, "scale", 1 / 400),
    ],
)
def test_the_word_becomes_a_number_of_the_environment(env_id, raw, key, value):
    spec = resolved(env_id, raw)
    entry = spec.saved_hyperparams
    assert spec.hyperparams == split(entry)
    if key == "scale":
        env = make_single_env(spec, training=True)
        assert isinstance(env, ScaleReward)
        assert env.scale == value
        assert set(spec.origins) == {"train_env_wrapper"}
        return
    expected = f"exp_0.3_{value}" if key == "learning_rate" else value
    assert entry[key] == expected
    assert set(spec.origins) == {name for name in raw if raw[name] != entry[name]}
    assert spec.origins[key].startswith("auto")
    assert list(entry) == list(raw)


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "rewards"),
    [
        ("Warehouse-v0", {}, (-0.1, -0.01, 1)),
        ("Warehouse-v0", POOR, (-0.1, -0.01, 1)),
        ("Warehouse-v0", {"shelf_reward": -5}, (-0.05, -0.01, 1)),
        ("Warehouse-v0", {"goal_reward": 400}, (-0.1, -0.0025, 1)),
        ("CliffWalking-v1", {}, (-1, -0.01)),  # nothing there earns anything
    ],
)
def test_the_dearest_step_of_training_costs_a_tenth_of_the_goal(env_id, env_kwargs, rewards):
    wrappers = [CLIP, SCALED["train_env_wrapper"]]
    spec = resolved(env_id, {"train_env_wrapper": wrappers, "env_kwargs": env_kwargs})
    model = transition_model(make_single_env(spec, training=True))
    possible = model.reward[model.prob > 0]
    assert np.unique(possible[possible != 0]) == pytest.approx(rewards)
    assert set(spec.origins) == {"train_env_wrapper"}


def test_other_settings_and_other_words_stay():
    raw = {"n_timesteps": 5, "gamma": 0.5, "engine": "auto", "learning_rate": "lin_0.1"}
    spec = resolved("Warehouse-v0", raw)
    assert (spec.saved_hyperparams, spec.origins) == (raw, None)


class Unknown(gym.Env):
    """Nobody knows its model."""

    observation_space = action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}


@pytest.mark.parametrize(
    ("env_id", "raw", "said"),
    [
        ("Warehouse-v0", {"gamma": "auto_5"}, "gamma: 'auto_5' is not auto"),
        ("Warehouse-v0", {"gamma": "automatic"}, "gamma: 'automatic' is not auto"),
        (
            "Warehouse-v0",
            {"n_timesteps": "auto_0"},
            "n_timesteps: 'auto_0' is not auto, or auto_1000",
        ),
        ("Unknown-v0", {"initial_q": "auto"}, "initial_q: auto needs an environment whose model"),
        ("Unknown-v0", SCALED, "scale: auto needs an environment whose model is known"),
        ("Unknown-v0", {"train_env_wrapper": CLIP}, "min_reward: auto needs an environment whose"),
        ("CartPole-v1", {"n_timesteps": "auto"}, "qlearning does not fit CartPole-v1"),
    ],
)
def test_what_cannot_be_worked_out_is_refused(env_id, raw, said):
    gym.register("Unknown-v0", Unknown)
    try:
        with pytest.raises(UserError, match=said):
            resolved(env_id, raw)
    finally:
        del gym.registry["Unknown-v0"]


@pytest.mark.parametrize(
    ("typed", "kept", "told"),
    [
        ({"env_kwargs": {"slip": 0.1}}, {"random_start": True, "shelf_reward": -10}, None),
        (
            {"env_kwargs": {"shelf_reward": -1}},
            {"random_start": True},
            {
                "train_env_kwargs": "without shelf_reward: -10, since what is asked for of the "
                "environment holds in training too"
            },
        ),
        ({"env_kwargs": {"shelf_reward": -10}}, {"random_start": True}, None),
        (
            {"env_kwargs": {"shelf_reward": -1}, "train_env_kwargs": {"shelf_reward": -10}},
            {"random_start": True, "shelf_reward": -10},
            None,
        ),
        ({"gamma": 0.5}, {"random_start": True, "shelf_reward": -10}, None),
    ],
)
def test_what_is_asked_for_wins_over_an_entrys_variant_for_training(typed, kept, told):
    entry = {"train_env_kwargs": {"random_start": True, "shelf_reward": -10}, **typed}
    entry["train_env_kwargs"] = {"random_start": True, "shelf_reward": -10}
    assert training_follows(entry, typed) == ({**entry, "train_env_kwargs": kept}, told)


@pytest.mark.parametrize(
    ("env_kwargs", "gamma", "note"),
    [
        (
            {"slip": 0.2},
            0.99,
            "at gamma 0.99 even exact planning scores 0.00 here; 0.9995: 1.00 (gamma: auto)",
        ),
        ({"slip": 0.2}, 0.9995, None),
        ({}, 0.99, None),
        ({}, 0.5, None),  # the shortest way is the best at any discount
        ({"slip": 0.2}, 1.0, None),
    ],
)
def test_what_a_discount_costs_is_planned_exactly(env_kwargs, gamma, note):
    spec = resolved("Warehouse-v0", {"n_timesteps": 1, "env_kwargs": env_kwargs})
    assert discount_note(spec, exact_evaluator(spec), gamma) == note


@pytest.mark.parametrize("algo", ["qlearning", "sarsa", "expected_sarsa", "double_qlearning"])
def test_shipped_settings_of_tables_follow_slipping_moves_and_small_rewards(algo):
    """As they are shipped these runs ended at the wall; now planning allows the best."""
    for env_kwargs in ({"slip": 0.2}, {"slip": 0.1, **POOR}):
        raw = {**read_hyperparams(algo, "Warehouse-v0"), "env_kwargs": env_kwargs}
        spec = resolved("Warehouse-v0", raw, algo)
        gamma = spec.hyperparams.algorithm["gamma"]
        assert discount_note(spec, exact_evaluator(spec), gamma) is None

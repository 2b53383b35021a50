"""Which engine trains networks: by algorithm, settings, environment, callbacks and budget alone."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import envs  # noqa: F401  # registers the environments
from agents import ALGORITHMS, load_algorithm
from agents.common.callbacks import BlockCallback, EpisodeBudget
from agents.networks import engine_setting
from agents.networks.engine_setting import Work


class Plain(BaseCallback):
    """Has to be asked after each step."""

    def _on_step(self):
        return True


class Sparse(BlockCallback):
    every_n_steps = 1000

    def _on_step(self):
        return True


def lake():
    return make_vec_env("FrozenLake-v1", 8, seed=0)


def pole():
    return gym.make("CartPole-v1")


LONG, SHORT = 200_000, 2_000
TOO_SHORT = "library: so short a training is not worth compiling"
BRIDGED = "compiled but for the environment: "
PLANS = [
    # agent, settings, environment, callback, budget, what is chosen
    ("ppo", {}, lake, None, LONG, "library"),
    ("dqn", {}, lake, None, LONG, "library"),
    ("a2c", {}, lake, None, LONG, "library"),
    ("double_dqn", {}, lake, None, LONG, "compiled"),
    ("deep_qlearning", {}, lake, None, LONG, "compiled"),
    ("double_dqn", {"engine": "library"}, lake, None, LONG, "library"),
    *((name, {"engine": "auto"}, lake, None, LONG, "compiled") for name in ("ppo", "dqn", "a2c")),
    *((name, {"engine": "auto"}, lake, None, SHORT, TOO_SHORT) for name in ("dqn", "a2c")),
    ("ppo", {"engine": "auto", "n_steps": 128}, lake, None, SHORT, TOO_SHORT),
    # A rollout is collected to its end, which here takes 16,384 steps.
    ("ppo", {"engine": "auto"}, lake, None, SHORT, "compiled"),
    ("double_dqn", {}, pole, None, SHORT, TOO_SHORT),
    ("double_dqn", {}, pole, None, LONG, "compiled"),
    ("double_dqn", {"engine": "compiled"}, lake, None, 1, "compiled"),
    # Not the steps count, but what is learnt from them.
    ("dqn", {"engine": "auto", "learning_starts": LONG}, pole, None, 10_000, TOO_SHORT),
    ("dqn", {"engine": "auto", "train_freq": 1}, pole, None, 10_000, "compiled"),
    ("ppo", {"engine": "auto", "n_epochs": 40}, lake, None, 12_000, "compiled"),
    # Callbacks and environments move the environment to Python, and never the engine.
    ("double_dqn", {}, lake, Sparse, LONG, "compiled"),
    ("double_dqn", {}, lake, lambda: EvalCallback(lake()), LONG, "compiled"),
    ("double_dqn", {}, lake, Plain, LONG, f"{BRIDGED}Plain must be asked after each step"),
    ("double_dqn", {}, lake, Plain, SHORT, TOO_SHORT),
    ("double_dqn", {}, lambda: gym.make("Acrobot-v1"), None, LONG,
     f"{BRIDGED}the environment's transition model is not known"),
    ("ppo", {"engine": "auto"}, lambda: VecNormalize(lake(), norm_obs=False), None, LONG,
     f"{BRIDGED}VecNormalize is not DummyVecEnv"),
    # Budgets in episodes.
    ("double_dqn", {}, lake, lambda: EpisodeBudget(10), 10**12, TOO_SHORT),
    ("double_dqn", {}, lake, lambda: [EpisodeBudget(10)], 10**12, TOO_SHORT),
    ("double_dqn", {}, lake, lambda: EpisodeBudget(10_000), 10**12, "compiled"),
]  # fmt: skip


@pytest.mark.parametrize("case", range(len(PLANS)))
def test_which_engine_trains(case, monkeypatch):
    name, settings, make_env, callback, budget, chosen = PLANS[case]
    model = load_algorithm(name)("MlpPolicy", make_env(), device="cpu", **settings)
    told = callback and callback()
    assert str(model.engine_plan(budget, told)) == chosen
    # Neither what has been compiled before nor the machine counts.
    monkeypatch.setattr(engine_setting, "is_compiled_before", lambda name: pytest.fail("asked"))
    monkeypatch.setattr(engine_setting, "machine_pace", lambda: pytest.fail("asked"))
    assert str(model.engine_plan(budget, told)) == chosen


@pytest.mark.parametrize(
    ("seconds", "is_worth_it"), [(engine_setting.WORTH_COMPILING * 1.2, True), (1.0, False)]
)
def test_what_is_worth_compiling(seconds, is_worth_it):
    work = Work("q", 0.0, 1, 1.0, 32, 2, 5_000, 5_000)
    n_updates = seconds / work.library_seconds
    assert replace(work, n_updates=n_updates).is_worth_compiling == is_worth_it


def test_work_by_hand():
    env = make_vec_env("CartPole-v1", 4, seed=0)
    ppo = load_algorithm("ppo")(
        "MlpPolicy", env, n_steps=100, batch_size=50, n_epochs=3, policy_kwargs={"net_arch": [8]}
    )
    # Three rollouts of 400 steps, each learnt from in three epochs of eight minibatches.
    n_weights = 4 * 8 + 8 * 2 + 4 * 8 + 8 * 1
    assert ppo.work(1000) == Work("policy", 1200, 4, 72, 50, 2, n_weights, n_weights)
    dqn = load_algorithm("dqn")(
        "MlpPolicy", lake(), learning_starts=200, train_freq=5, gradient_steps=2, batch_size=16,
        policy_kwargs={"net_arch": [8, 8]},
    )  # fmt: skip
    # Twice in each 40 of 800 steps; a number as observation needs one column of the first layer.
    dense = 8 * 8 + 8 * 4
    assert dqn.work(1000) == Work("q", 1000, 8, 40, 16, 3, 16 * 8 + dense, dense)
    dqn.gradient_steps = -1  # as many as steps
    assert dqn.work(1000).n_updates == 800


def test_engines_of_the_table_are_those_of_the_classes():
    """What `--engine` offers without importing a class is what its constructor takes."""
    for name, entry in ALGORITHMS.items():
        if entry.is_installed:
            default = engine_default(name)
            assert (len(entry.engines) > 1) == (default is not None), name
            assert default in {None, *entry.engines[:1]}, name


def engine_default(name):
    from pipeline.settings.values import algorithm_parameters

    parameter = algorithm_parameters(load_algorithm(name)).get("engine")
    return None if parameter is None else parameter.default


def test_auto_trains_as_the_engine_that_it_chooses():
    def weights(engine, n_steps):
        env = make_vec_env("FrozenLake-v1", 2, seed=0)
        settings = {"n_steps": 32, "batch_size": 32, "policy_kwargs": {"net_arch": [8]}}
        model = load_algorithm("ppo")("MlpPolicy", env, engine=engine, seed=0, **settings)
        model.learn(n_steps)
        return model.engine_in_use, np.concatenate(
            [tensor.numpy().ravel() for tensor in model.policy.state_dict().values()]
        )

    for n_steps, chosen in ((256, "library"), (12_000, "compiled")):
        words, learnt = weights("auto", n_steps)
        assert words.partition(":")[0] == chosen
        np.testing.assert_array_equal(learnt, weights(chosen, n_steps)[1])

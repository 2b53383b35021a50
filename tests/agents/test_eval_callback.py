"""The library's `EvalCallback` beside a compiled training finds what it finds beside any other."""

from functools import partial

import numpy as np
import pytest
from gymnasium.wrappers import TransformReward
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import Horizon, calls_until_multiple
from rl_yardstick.envs.wrappers import DiscretizeObservation

LAKE, WAREHOUSE, CART = "FrozenLake-v1", "envs:Warehouse-v0", "CartPole-v1"
WIDTHS = {"low": [-2.4, -3.0, -0.21, -3.0], "high": [2.4, 3.0, 0.21, 3.0]}
IN_BINS = partial(DiscretizeObservation, bins=[1, 6, 12, 6], **WIDTHS)
NETWORK = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [16]}}
STEPS = 800


class LibraryEvaluation(EvalCallback):
    """Says when it acts, and is not answered in compiled code."""

    def horizon(self):
        return Horizon(calls_until_multiple(self.n_calls, self.eval_freq))

    def pass_over(self, n_calls, n_episodes):
        self.n_calls += n_calls


@pytest.fixture
def python_steps(monkeypatch):
    """Counts what environments are stepped in Python."""
    stepped = []
    step_wait = DummyVecEnv.step_wait
    monkeypatch.setattr(
        DummyVecEnv, "step_wait", lambda self: stepped.append(self) or step_wait(self)
    )
    return stepped


def found(algo, env_id, engine, folder, kind=EvalCallback, wrapper=None, n_envs=2, **settings):
    """All that an evaluation leaves behind, beside a training that goes on after it."""
    deterministic = settings.pop("deterministic", True)
    monitored = {"wrapper_class": wrapper, "monitor_dir": str(folder / "eval")}
    eval_env = make_vec_env(env_id, n_envs, seed=7, **monitored)
    train_env = make_vec_env(env_id, 2, seed=1, wrapper_class=wrapper)
    model = load_algorithm(algo)(env=train_env, seed=0, engine=engine, **settings)
    often = {"n_eval_episodes": 5, "eval_freq": STEPS // 8, "deterministic": deterministic}
    callback = kind(eval_env, log_path=str(folder), best_model_save_path=str(folder), **often)
    model.learn(STEPS, callback=callback, log_interval=None)
    eval_env.close()
    assert (folder / "best_model.zip").is_file()
    with np.load(folder / "evaluations.npz") as file:
        arrays = {name: file[name].tolist() for name in file.files}
    texts = [(folder / "eval" / f"{i}.monitor.csv").read_text() for i in range(n_envs)]
    return {
        "file": arrays,
        "means": (callback.best_mean_reward, callback.last_mean_reward),
        "logged": dict(model.logger.name_to_value),
        "rows": [[row.split(",")[:2] for row in text.splitlines()[1:]] for text in texts],
        "generators": [env.unwrapped.np_random.bit_generator.state for env in eval_env.envs],
        "learnt": {name: part.numpy() for name, part in model.policy.state_dict().items()},
    }


RANDOMLY = {"deterministic": False}
TABLES = [
    ("qlearning", LAKE, None, {**RANDOMLY, "exploration": "gaussian_noise"}, 3),
    ("qlearning", CART, IN_BINS, {}, 1),
]


@pytest.mark.parametrize(("algo", "env_id", "wrapper", "settings", "n_envs"), TABLES)
def test_tables_find_what_is_found_in_python(
    algo, env_id, wrapper, settings, n_envs, tmp_path, python_steps
):
    results, kwargs = [], {"wrapper": wrapper, "n_envs": n_envs, **settings}
    for engine in ("interpreted", "compiled"):
        python_steps.clear()
        results.append(found(algo, env_id, engine, tmp_path / engine, **kwargs))
    np.testing.assert_equal(results[1], results[0])
    assert len(results[0]["file"]["results"]) == 4
    assert not python_steps, "all was played in compiled code"


@pytest.mark.parametrize(
    ("algo", "env_id", "settings"),
    [
        ("ppo", CART, {"n_steps": 64}),
        ("dqn", LAKE, {}),
    ],
)
def test_networks_find_what_the_library_finds(algo, env_id, settings, tmp_path, python_steps):
    settings = {**NETWORK, **settings}
    library = found(algo, env_id, "compiled", tmp_path / "a", LibraryEvaluation, **settings)
    assert python_steps
    python_steps.clear()
    ours = found(algo, env_id, "compiled", tmp_path / "b", **settings)
    np.testing.assert_equal(ours, library)
    assert not python_steps


@pytest.mark.parametrize(
    ("algo", "env_id", "wrapper", "settings"),
    [
        ("ppo", CART, None, {**NETWORK, "n_steps": 64, "deterministic": False}),
        ("qlearning", LAKE, partial(TransformReward, func=lambda r: 2 * r), {}),
    ],
)
def test_what_is_not_covered_is_the_librarys(algo, env_id, wrapper, settings, python_steps):
    deterministic = settings.pop("deterministic", True)
    train_env = make_vec_env(env_id, 1, seed=0)
    model = load_algorithm(algo)(env=train_env, seed=0, engine="compiled", **settings)
    eval_env = make_vec_env(env_id, 1, seed=1, wrapper_class=wrapper)
    callback = EvalCallback(eval_env, eval_freq=100, deterministic=deterministic, verbose=0)
    model.learn(250, callback=callback)
    assert python_steps
    assert set(map(id, python_steps)) == {id(eval_env)}

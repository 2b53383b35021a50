"""Specs, agents and short runs, as most of these tests want them; tables of what is said."""

from pathlib import Path

from rl_yardstick.agents import load_algorithm
from rl_yardstick.pipeline.run import Run
from rl_yardstick.pipeline.settings import read_spec, read_yaml
from rl_yardstick.pipeline.training import train

LAKE, CART, SWING, WAREHOUSE = "FrozenLake-v1", "CartPole-v1", "Pendulum-v1", "Warehouse-v0"
TABLES = read_yaml(Path(__file__).with_name("settings.yml"))


def spec_of(algo, env_id=LAKE, entry=None, *, n_timesteps=1, seed=0, **fields):
    """Of a run that draws nothing."""
    entry = entry or {}
    budget = {} if "n_episodes" in entry else {"n_timesteps": n_timesteps}
    fields = {"pictures": False, "device": "cpu", **fields}
    return read_spec(algo, env_id, {**budget, **entry}, seed=seed, **fields)


def run_of(spec, folder="logs", **fields):
    """A new run folder of a spec, and the outcome of its training."""
    run = Run.claim(Path(folder), spec, **fields)
    with run:
        run.begin(spec, {"seed": spec.seed}, "train.py")
        return run, train(spec, run)


def trained(algo, env_id=LAKE, entry=None, *, folder="logs", **fields):
    """A finished run: its folder, and the outcome."""
    return run_of(spec_of(algo, env_id, entry, **fields), folder)


def agent_of(name, env, **arguments):
    """An agent that has learnt nothing, by its usual policy."""
    algorithm = load_algorithm(name)
    return algorithm(next(iter(algorithm.policy_aliases)), env, **{"seed": 0, **arguments})

"""Specifications, agents and short runs, as most of these tests want them."""

from rich.console import Console

from rl_yardstick.agents import load_algorithm
from rl_yardstick.pipeline.models.choose import find_model, with_statistics
from rl_yardstick.pipeline.settings.hyperparams import split
from rl_yardstick.pipeline.train_spec import TrainSpec
from rl_yardstick.pipeline.training import train

LAKE, CART, SWING, WAREHOUSE = "FrozenLake-v1", "CartPole-v1", "Pendulum-v1", "Warehouse-v0"


def spec_of(algo, env_id=LAKE, entry=None, *, n_timesteps=1, seed=0, **fields):
    """Of a run that draws nothing and prints nothing."""
    raw = {"n_timesteps": n_timesteps, **(entry or {})}
    fields = {"verbose": 0, "pictures": False, "device": "cpu", **fields}
    return TrainSpec(algo, env_id, split(raw), raw, seed, **fields)


def trained(algo, env_id=LAKE, entry=None, *, command="train.py", **fields):
    """The outcome of a run."""
    spec = spec_of(algo, env_id, entry, **fields)
    return train(spec, Console(quiet=True), {}, command)


def agent_of(name, env, **arguments):
    """An agent that has learnt nothing, by its usual policy."""
    algorithm = load_algorithm(name)
    return algorithm(next(iter(algorithm.policy_aliases)), env, **{"seed": 0, **arguments})


def choose_model(request):
    """The requested model, ready to play."""
    return with_statistics(find_model(request), request.statistics)

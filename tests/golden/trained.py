"""What training and planning produce: digests of tables and weights, optima, values of policies.

Agents are made by their names in the registry, environments by their ids, and models are planned on
by the functions that README shows. So this runs on any commit, wherever its modules lie.
"""

import hashlib
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import yaml

N_STEPS = 1000

ASKED = yaml.safe_load(Path(__file__).with_name("trainings.yml").read_text(encoding="utf-8"))
NETWORKS, ENVIRONMENT_ARGUMENTS = ASKED["networks"], ASKED["environment_arguments"]
LIBRARY_ENVIRONMENTS = ASKED["library_environments"]
# Its first two columns are the contexts: numbers, so that linear agents fit too.
LOG = "".join(
    f"{row % 7 / 7},{row % 5 / 5},{row % 3},{int(row % 4 == 0)},0.333333\n" for row in range(600)
)


class Thing(NamedTuple):
    """Something that can be looked at."""

    name: str  # by which it is found again
    holds: str  # where its value is the same: ``anywhere``, or ``here``: on such a machine
    look: Callable[[], str | list[str]]  # says what it is, in a line or more
    needs: str = ""  # what the names of those things begin with that have to be done before


def digest(*arrays):
    """Of arrays, with their types and shapes."""
    known = hashlib.sha256()
    for array in map(np.asarray, arrays):
        known.update(f"{array.dtype} {array.shape} ".encode())
        known.update(np.ascontiguousarray(array).tobytes())
    return known.hexdigest()[:10]


def trainings():
    """Every agent on every environment that it fits, in all its engines."""
    for env_id in environments():
        arguments = ENVIRONMENT_ARGUMENTS.get(env_id, {})
        for algo in fitting(env_id, arguments):
            if algo not in NETWORKS or len(engines(algo)) > 1 or env_id in LIBRARY_ENVIRONMENTS:
                yield training((env_id, arguments, algo, {}))
    for case in ASKED["cases"]:
        yield training(case)


def environments():
    """Ids of the project's environments and of those that everybody knows."""
    folder = package("envs").__name__  # and importing it registers them
    places = {name: str(spec.entry_point) for name, spec in gym.registry.items()}
    own = [name for name, place in places.items() if place.startswith(f"{folder}.")]
    return sorted([*own, *ASKED["other_environments"]])


def package(name):
    """A package of the checkout that is looked at."""
    return importlib.import_module(f"rl_yardstick.{name}")


def fitting(env_id, arguments):
    """Names of the agents that can work with an environment, in the order of the alphabet."""
    with gym.make(env_id, **arguments) as env:
        masks = hasattr(env.unwrapped, "action_masks")
        spaces = env.observation_space, env.action_space
    agents = package("agents")
    return sorted(agents.fitting_algorithms(*spaces, "Bandit-" in env_id, masks))


def engines(algo):
    """The engines that can be asked for; one empty word where there is no choice."""
    entry = package("agents").ALGORITHMS[algo]
    chosen = tuple(word for word in entry.engines if word != "auto")
    return tuple(sorted(chosen)) if len(chosen) > 1 else ("",)


def training(case):
    """One training: its name, how far its digests hold, and how to do it."""
    env_id, env_arguments, algo, arguments = case
    shown = {} if env_id in ENVIRONMENT_ARGUMENTS else env_arguments
    words = [f"{key}:{value}" for key, value in {**shown, **arguments}.items()]
    name = " ".join(["train", env_id, algo, *words]).replace("'", "")
    exact = algo in ASKED["exact_everywhere"] and env_id not in ASKED["inexact_worlds"]
    exact &= not {"boltzmann", "gaussian_noise", "exponential"} & set(map(str, arguments.values()))
    return Thing(name, "anywhere" if exact else "here", lambda: trained_in_all(case))


def trained_in_all(case):
    """What all engines of an agent come to, one after the other if that is not the same."""
    found = {}
    for engine in engines(case[2]):
        # The library's own loop is the library's, which a few environments show well enough.
        if engine == "library" and case[0] not in LIBRARY_ENVIRONMENTS:
            continue
        try:
            text = trained(case, engine)
        except Exception as error:  # noqa: BLE001  # that is what becomes of it
            text = f"{type(error).__name__}: {error}"
        found.setdefault(text, []).append(engine)
    return "; ".join(
        f"{'+'.join(names)}: {text}".removeprefix(": ") for text, names in found.items()
    )


def trained(case, engine):
    """Train an agent, and say in a line what it has become and what it has seen."""
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.utils import LinearSchedule
    from stable_baselines3.common.vec_env import DummyVecEnv

    env_id, env_arguments, algo, given = case
    n_steps, arguments = NETWORKS.get(algo, (N_STEPS, {}))
    arguments = {**arguments, **given, **({"engine": engine} if engine else {})}
    n_envs = arguments.pop("n_envs", 1)
    for key, value in arguments.items():
        if value == "falling":
            arguments[key] = LinearSchedule(0.5 if algo not in NETWORKS else 3e-3, 1e-4, 1.0)
    monitors = [Monitor(gym.make(env_id, **env_arguments)) for _ in range(n_envs)]
    makers = [lambda env=env: env for env in monitors]
    env = DummyVecEnv(makers) if n_envs > 1 else monitors[0]
    algorithm = package("agents").load_algorithm(algo)
    policies = algorithm.policy_aliases
    policy = "MlpPolicy" if "MlpPolicy" in policies else next(iter(policies))
    agent = algorithm(policy, env, seed=0, **arguments)
    agent.learn(n_steps)
    weights = agent.policy.state_dict()
    parts = [weights[name].detach().cpu().numpy() for name in sorted(weights)]
    returns = [value for monitor in monitors for value in monitor.get_episode_rewards()]
    lengths = [length for monitor in monitors for length in monitor.get_episode_lengths()]
    texts = [
        f"{agent.num_timesteps} steps",
        f"weights {digest(*parts)} in {len(parts)}",
        f"{len(returns)} episodes {digest(np.float64(returns), np.int64(lengths))}",
    ]
    if isinstance(agent.observation_space, gym.spaces.Discrete):
        actions, _ = agent.predict(np.arange(agent.observation_space.n), deterministic=True)
        texts.append(f"actions {digest(np.int64(actions))}")
    return ", ".join(texts)


def plans():
    """Optima, optimal values and the values of a few policies, of each environment with a model."""
    for env_id in environments():
        arguments = ENVIRONMENT_ARGUMENTS.get(env_id, {})
        with gym.make(env_id, **arguments) as env:
            if not hasattr(type(env.unwrapped), "transition_model") and not hasattr(
                env.unwrapped, "initial_state_distrib"
            ):
                continue
        for what in ("optimum", "plan at 0.99", "random policy", "constant policies"):
            yield Thing(f"plan {env_id} {what}", "here", lambda e=env_id, w=what: planned(e, w))


def model_of(env):
    """The transition model of one of the project's environments, or of Gymnasium's toy_text."""
    base = env.unwrapped
    if hasattr(base, "transition_model"):
        return base.transition_model()
    return package("mdp").TransitionModel.from_gymnasium(base.P, base.initial_state_distrib)


def planned(env_id, what):
    """What planning or evaluating on the model of an environment comes to."""
    mdp = package("mdp")
    with gym.make(env_id, **ENVIRONMENT_ARGUMENTS.get(env_id, {})) as env:
        model, limit = model_of(env), env.spec.max_episode_steps if env.spec else None
    horizon = min(limit or 200, 200)
    if what == "optimum":
        best = mdp.finite_horizon_optimum(model, horizon=horizon)
        choices = mdp.optimal_choices(model, horizon)
        return f"{best.start_value!r}, V* {digest(best.values)}, choices {digest(*choices)}"
    if what.startswith("plan"):
        found = [mdp.value_iteration(model, 0.99), mdp.policy_iteration(model, 0.99)]
        return "; ".join(
            f"{plan.start_value!r}, V* {digest(plan.values)}, Q* {digest(plan.action_values)}, "
            f"policy {digest(plan.policy)}"
            for plan in found
        )
    if what == "random policy":
        uniform = np.full((model.n_states, model.n_actions), 1 / model.n_actions)
        value = mdp.policy_return(model, uniform, horizon=horizon)
        values = mdp.state_values(model, uniform, horizon)
        return f"{told(value)}, V {digest(values)}"
    constant = [np.full(model.n_states, action) for action in range(min(model.n_actions, 3))]
    values = [told(mdp.policy_return(model, policy, horizon=horizon)) for policy in constant]
    return "; ".join([*values, f"best baseline {mdp.baseline_return(model, horizon)!r}"])


def told(value):
    """The moments of a policy's return."""
    return (
        f"return {value.expected_return!r} var {value.return_variance!r} "
        f"length {value.expected_length!r}"
    )


def things(folder):
    """Everything that this file looks at; files that it needs are made in ``folder``."""
    (folder / "log.csv").write_text(f"x,y,arm,reward,propensity\n{LOG}")
    yield from trainings()
    yield from plans()

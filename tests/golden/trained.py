"""What training and planning produce: digests of tables and weights, optima, values of policies.

Agents are made by their names in the registry, environments by their ids, and models are planned on
by the functions that README shows. So this runs on any commit, wherever its modules lie.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

N_STEPS = 1000

# What is trained on beside all environments of the project.
OTHER_ENVIRONMENTS = (
    *("Acrobot-v1", "Blackjack-v1", "CartPole-v1", "CliffWalking-v1", "CliffWalkingSlippery-v1"),
    *("FrozenLake-v1", "FrozenLake8x8-v1", "MountainCar-v0", "MountainCarContinuous-v0"),
    *("Pendulum-v1", "Taxi-v4"),
)
# Its first two columns are the contexts: numbers, so that linear agents fit too.
LOG = "".join(
    f"{row % 7 / 7},{row % 5 / 5},{row % 3},{int(row % 4 == 0)},0.333333\n" for row in range(600)
)
ENVIRONMENT_ARGUMENTS: dict[str, dict[str, Any]] = {
    "CliffWalking-v1": {"max_episode_steps": 200},
    "CliffWalkingSlippery-v1": {"max_episode_steps": 200},
    "ReplayBandit-v0": {"log": "log.csv"},
}

# Agents of a table whose arithmetic is the same on every processor: sums, products, comparisons.
EXACT_EVERYWHERE = (
    *("double_qlearning", "dyna_q", "epsilon_greedy", "expected_sarsa", "monte_carlo"),
    *("n_step_sarsa", "n_step_tree_backup", "off_policy_monte_carlo", "optimal"),
    *("policy_iteration", "q_lambda", "qlearning", "random", "sarsa", "sarsa_lambda"),
    "value_iteration",
)
# Environments whose steps or models come from more than that: sines, logarithms, exponentials.
INEXACT_WORLDS = (
    *("Acrobot-v1", "CartPole-v1", "GaussianBandit-v0", "JacksCarRental-v0", "LinearBandit-v0"),
    *("MaximizationBias-v0", "MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1"),
)
# Agents with networks train for as few steps as have them learn at all, and those that have no
# engine of ours, on few environments: theirs is not our code.
ON_POLICY = {"n_steps": 32, "batch_size": 16, "n_epochs": 2}
OFF_POLICY = {"learning_starts": 16, "batch_size": 8, "buffer_size": 500}
Q_NETWORK = {**OFF_POLICY, "target_update_interval": 32}
NETWORKS: dict[str, tuple[int, dict[str, Any]]] = {
    "a2c": (64, {}),
    "ars": (64, {"n_delta": 2}),
    "crossq": (32, OFF_POLICY),
    "ddpg": (32, OFF_POLICY),
    "deep_qlearning": (96, OFF_POLICY),
    "double_dqn": (96, Q_NETWORK),
    "dqn": (96, Q_NETWORK),
    "ppo": (64, ON_POLICY),
    "ppo_lstm": (32, ON_POLICY),
    "ppo_mask": (64, ON_POLICY),
    "qrdqn": (64, Q_NETWORK),
    "sac": (32, OFF_POLICY),
    "td3": (32, OFF_POLICY),
    "tqc": (32, OFF_POLICY),
    "trpo": (64, {"n_steps": 32, "batch_size": 16}),
}
LIBRARY_ENVIRONMENTS = ("CartPole-v1", "FrozenLake-v1", "Pendulum-v1", "Warehouse-v0")

# Settings other than the default ones: environment, its arguments, agent, the agent's arguments.
Case = tuple[str, dict[str, Any], str, dict[str, Any]]
SLIPPING = {"slip": 0.1, "shelf_reward": -5}
CART_BOUNDS = {"low": [-2.4, -3.0, -0.2, -3.0], "high": [2.4, 3.0, 0.2, 3.0]}
CASES: tuple[Case, ...] = (
    ("FrozenLake-v1", {}, "qlearning", {"learning_rate": "falling", "tie_breaking": "first"}),
    ("FrozenLake-v1", {}, "qlearning", {"learning_rate": "sample_average", "initial_q": 1.0}),
    ("FrozenLake-v1", {}, "qlearning", {"exploration_decay": "exponential", "gamma": 0.9}),
    ("FrozenLake-v1", {}, "qlearning", {"exploration_decay": "constant", "n_envs": 3}),
    ("FrozenLake-v1", {}, "sarsa", {"exploration": "boltzmann", "temperature": "falling"}),
    ("FrozenLake-v1", {}, "sarsa", {"n_envs": 4, "initial_q_std": 0.1}),
    ("FrozenLake-v1", {"is_slippery": False}, "double_qlearning", {"exploration_fraction": 0.1}),
    ("FrozenLake-v1", {"map_name": "8x8"}, "expected_sarsa", {"skip_terminal_update": True}),
    ("FrozenLake-v1", {}, "n_step_sarsa", {"n_steps": 8, "n_envs": 2}),
    ("FrozenLake-v1", {}, "n_step_tree_backup", {"target_policy": "greedy", "n_steps": 2}),
    ("FrozenLake-v1", {}, "sarsa_lambda", {"trace_type": "accumulating", "trace_decay": 0.5}),
    ("FrozenLake-v1", {}, "q_lambda", {"trace_type": "dutch", "n_envs": 2}),
    ("FrozenLake-v1", {}, "monte_carlo", {"every_visit": True}),
    ("FrozenLake-v1", {}, "dyna_q", {"planning_steps": 20, "outcomes_kept": 3}),
    ("FrozenLake-v1", {}, "prioritized_sweeping", {"planning_steps": 1, "threshold": 0.01}),
    ("FrozenLake-v1", {}, "semi_gradient_q", {"learning_rate": "falling", "gamma": 0.9}),
    ("FrozenLake-v1", {}, "reinforce", {"baseline": "value", "gamma_power": False}),
    ("Taxi-v4", {}, "qlearning", {"mask_actions": True}),
    ("Taxi-v4", {}, "sarsa", {"mask_actions": True, "exploration": "boltzmann"}),
    ("Taxi-v4", {}, "value_iteration", {"gamma": 0.9}),
    ("Warehouse-v0", {}, "double_qlearning", {"mask_actions": True, "tie_breaking": "first"}),
    ("Warehouse-v0", SLIPPING, "qlearning", {"exploration": "gaussian_noise"}),
    ("Warehouse-v0", SLIPPING, "dyna_q", {"mask_actions": True}),
    ("Warehouse-v0", {"random_start": True}, "q_lambda", {"mask_actions": True}),
    ("CartPole-v1", {}, "semi_gradient_sarsa", {**CART_BOUNDS, "n_tilings": 4, "n_envs": 2}),
    ("CartPole-v1", {}, "semi_gradient_q", {**CART_BOUNDS, "n_tiles": 5}),
    ("CartPole-v1", {}, "actor_critic", {**CART_BOUNDS, "value_step_size": 0.1}),
    ("CartPole-v1", {}, "reinforce", {**CART_BOUNDS, "baseline": "value"}),
    ("CartPole-v1", {}, "ppo", {"n_envs": 2, "learning_rate": "falling", "clip_range": 0.1}),
    ("CartPole-v1", {}, "a2c", {"n_envs": 3, "gae_lambda": 0.9, "normalize_advantage": True}),
    ("CartPole-v1", {}, "dqn", {"n_envs": 2, "train_freq": 2, "exploration_fraction": 0.9}),
    ("Warehouse-v0", {}, "double_dqn", {"mask_actions": True}),
    ("BernoulliBandit-v0", {"pulls": 300}, "epsilon_greedy", {"exploration_decay": "linear"}),
    ("BernoulliBandit-v0", {"probabilities": [0.4, 0.5]}, "ucb", {"tie_breaking": "first"}),
    ("GaussianBandit-v0", {}, "thompson", {"likelihood": "gaussian"}),
    ("GaussianBandit-v0", {}, "gradient_bandit", {"baseline": False, "learning_rate": 0.4}),
    ("SegmentBandit-v0", {"batch_size": 10}, "thompson", {"ignore_context": True}),
    ("SegmentBandit-v0", {}, "exp3", {"mixing": 0.3}),
    ("LinearBandit-v0", {}, "linucb", {"alpha": 0.3, "ridge": 2.0}),
)


class Thing(NamedTuple):
    """Something that can be looked at.

    Attributes:
        name: by which it is found again.
        holds: where its value is the same: ``anywhere``, with the same ``python``, or ``here``:
            with the same processor and libraries.
        look: says what it is, as a line or as a list of lines.
        needs: what the names of those things begin with that have to be done before.
    """

    name: str
    holds: str
    look: Callable[[], str | list[str]]
    needs: str = ""


def digest(*arrays: Any) -> str:
    """Of arrays, with their types and shapes."""
    known = hashlib.sha256()
    for array in map(np.asarray, arrays):
        known.update(f"{array.dtype} {array.shape} ".encode())
        known.update(np.ascontiguousarray(array).tobytes())
    return known.hexdigest()[:10]


def trainings() -> Iterator[Thing]:
    """Every agent on every environment that it fits, in all its engines."""
    for env_id in environments():
        arguments = ENVIRONMENT_ARGUMENTS.get(env_id, {})
        for algo in fitting(env_id, arguments):
            if algo not in NETWORKS or len(engines(algo)) > 1 or env_id in LIBRARY_ENVIRONMENTS:
                yield training((env_id, arguments, algo, {}))
    for case in CASES:
        yield training(case)


def environments() -> list[str]:
    """Ids of the project's environments and of those that everybody knows."""
    folder = package("envs").__name__  # and importing it registers them
    places = {name: str(spec.entry_point) for name, spec in gym.registry.items()}
    own = [name for name, place in places.items() if place.startswith(f"{folder}.")]
    return sorted([*own, *OTHER_ENVIRONMENTS])


def package(name: str) -> Any:
    """A package of the checkout that is looked at."""
    return importlib.import_module(f"rl_yardstick.{name}")


def fitting(env_id: str, arguments: dict[str, Any]) -> list[str]:
    """Names of the agents that can work with an environment, in the order of the alphabet."""
    with gym.make(env_id, **arguments) as env:
        masks = hasattr(env.unwrapped, "action_masks")
        spaces = env.observation_space, env.action_space
    agents = package("agents")
    return sorted(agents.fitting_algorithms(*spaces, "Bandit-" in env_id, masks))


def engines(algo: str) -> tuple[str, ...]:
    """The engines that can be asked for; one empty word where there is no choice."""
    entry = package("agents").ALGORITHMS[algo]
    chosen = tuple(word for word in entry.engines if word != "auto")
    return tuple(sorted(chosen)) if len(chosen) > 1 else ("",)


def training(case: Case) -> Thing:
    """One training: its name, how far its digests hold, and how to do it."""
    env_id, env_arguments, algo, arguments = case
    shown = {} if env_id in ENVIRONMENT_ARGUMENTS else env_arguments
    words = [f"{key}:{value}" for key, value in {**shown, **arguments}.items()]
    name = " ".join(["train", env_id, algo, *words]).replace("'", "")
    exact = algo in EXACT_EVERYWHERE and env_id not in INEXACT_WORLDS
    exact &= not {"boltzmann", "gaussian_noise", "exponential"} & set(map(str, arguments.values()))
    return Thing(name, "anywhere" if exact else "here", lambda: trained_in_all(case))


def trained_in_all(case: Case) -> str:
    """What all engines of an agent come to, one after the other if that is not the same."""
    found: dict[str, list[str]] = {}
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


def trained(case: Case, engine: str) -> str:
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
    env: Any = DummyVecEnv(makers) if n_envs > 1 else monitors[0]
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


def plans() -> Iterator[Thing]:
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


def model_of(env: gym.Env[Any, Any]) -> Any:
    """The transition model of one of the project's environments, or of Gymnasium's toy_text."""
    base: Any = env.unwrapped
    if hasattr(base, "transition_model"):
        return base.transition_model()
    return package("mdp").TransitionModel.from_gymnasium(base.P, base.initial_state_distrib)


def planned(env_id: str, what: str) -> str:
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


def told(value: Any) -> str:
    """The moments of a policy's return."""
    return (
        f"return {value.expected_return!r} var {value.return_variance!r} "
        f"length {value.expected_length!r}"
    )


def things(folder: Path) -> Iterator[Thing]:
    """Everything that this file looks at; files that it needs are made in ``folder``."""
    (folder / "log.csv").write_text(f"x,y,arm,reward,propensity\n{LOG}")
    yield from trainings()
    yield from plans()

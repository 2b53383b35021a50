"""The registry of agents: names, classes and supported spaces; users can add to it."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium import spaces

from rl_yardstick.agents.own_classes import fault_of, is_plain, parameters_of
from rl_yardstick.envs.finite_spaces import bijection_of, counts_from_zero, table_size

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


@dataclass(frozen=True)
class AlgorithmEntry:
    """One agent that can be trained.

    Attributes:
        entry_point: the class, as ``"module:Class"``; imported only when needed.
        summary: the agent in a few words.
        observations: names of the Gymnasium spaces that it can observe; empty for any space, which
            the class itself must check.
        actions: names of the Gymnasium spaces that it can act in, likewise.
        observation_shape: the only observation shape that it supports, or None for any.
        for_bandits: whether it considers only the next reward.
        needs_masks: whether the environment must provide action masks.
        has_memory: whether its actions depend on earlier observations, too.
        package: the import name of an optional package that it needs, or None.
        extra: the extra of this distribution that installs that package.
        engines: values of its argument ``engine``, the default first; one or none if it has only
            one engine and no such argument.
    """

    entry_point: str
    summary: str
    observations: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    observation_shape: tuple[int, ...] | None = None
    for_bandits: bool = False
    needs_masks: bool = False
    has_memory: bool = False
    package: str | None = None
    extra: str | None = None
    engines: tuple[str, ...] = ()

    @property
    def family(self) -> str:
        """The folder or file of `agents` with the class; empty if it is elsewhere."""
        module, prefix = self.entry_point.partition(":")[0], "rl_yardstick.agents."
        return module[len(prefix) :].split(".")[0] if module.startswith(prefix) else ""

    @property
    def is_installed(self) -> bool:
        """Whether the package that the agent needs is installed."""
        return self.package is None or importlib.util.find_spec(self.package) is not None

    @property
    def install_command(self) -> str:
        """The command that installs this package."""
        what = f"'rl-yardstick[{self.extra}]'" if self.extra else self.package
        return f"pip install {what}"

    @property
    def numbers_spaces(self) -> bool:
        """Whether it numbers the members of finite spaces, where it needs Discrete ones."""
        return self.family in {"tabular", "linear", "planning"} and "Discrete" in self.observations

    def misfit(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> str:
        """The reason why the agent cannot work with these spaces; empty if it can."""
        for space, known, role in (
            (observation_space, self.observations, "observes"),
            (action_space, self.actions, "acts in"),
        ):
            if not known or (self.numbers_spaces and bijection_of(space, known) is not None):
                continue
            if type(space).__name__ not in known:
                size = table_size(observation_space, action_space) if self.numbers_spaces else ""
                return f"it {role} {' or '.join(known)} spaces, not {space}{size}"
            # Networks of Stable-Baselines3 send fractions, and take vectors and images.
            is_odd = isinstance(space, spaces.MultiDiscrete) and len(space.shape) > 1
            if isinstance(space, spaces.Box):
                is_odd = space.shape == () or (role == "acts in" and space.dtype.kind != "f")
            if is_odd and self.entry_point.startswith(_NETWORKS):
                return f"it {role} no {space}"
            # The one-hot encoding of Stable-Baselines3 and every table count from zero.
            if not counts_from_zero(space):
                wrapper = "TransformObservation" if role == "observes" else "TransformAction"
                way_out = "" if bijection_of(space) else f": shift it by Gymnasium's {wrapper}"
                return f"it needs Discrete spaces that start at 0, not {space}{way_out}"
        shape = self.observation_shape
        if shape is not None and observation_space.shape != shape:
            return f"it needs observations of shape {shape}, not {observation_space.shape}"
        return ""

    def numbered(self, env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        """The environment; finite spaces that do not fit are numbered, with `numbers_spaces`."""
        from rl_yardstick.envs.wrappers import numbered

        return numbered(env, self.observations, self.actions) if self.numbers_spaces else env

    def env_misfit(self, env: gym.Env[Any, Any]) -> str:
        """The reason why the agent cannot work with the environment; empty if it can."""
        from rl_yardstick.envs.wrappers import has_masks

        if self.for_bandits and not is_bandit(env):
            return "it is for bandits, where a pull changes nothing but its own reward"
        if self.needs_masks and not has_masks(env):
            return (
                "it needs to be told which actions are valid, by a method action_masks() or by "
                "info['action_mask']"
            )
        return self.misfit(env.observation_space, env.action_space)


def is_bandit(env: gym.Env[Any, Any]) -> bool:
    """Whether the environment is one of `envs.bandits`."""
    from rl_yardstick.envs.bandits import Bandit

    return isinstance(env.unwrapped, Bandit)


DISCRETE = ("Discrete",)
LINEAR_INPUTS = ("Box", "Discrete")
NETWORK_INPUTS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary", "Dict")
POLICY_GRADIENT_OUTPUTS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")
CONTINUOUS = ("Box",)
TABLE_ENGINES = ("auto", "compiled", "interpreted")
LIBRARY_ENGINES = ("library", "compiled", "auto")
NETWORK_ENGINES = ("auto", "compiled", "library")
VECTOR_INPUTS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")


def _family(
    prefix: str,
    observations: tuple[str, ...],
    actions: tuple[str, ...],
    by: str = "",
    **fields: Any,
) -> Callable[..., AlgorithmEntry]:
    """A function that makes the entries of similar agents, whose summaries end with ``by``."""

    def entry(place: str, summary: str, **own: Any) -> AlgorithmEntry:
        spaces_of_all = {"observations": observations, "actions": actions}
        return AlgorithmEntry(prefix + place, summary + by, **{**spaces_of_all, **fields, **own})

    return entry


OURS = "rl_yardstick.agents."
_NETWORKS = "stable_baselines3:", "sb3_contrib:", f"{OURS}library:", f"{OURS}random_search:"
_tabular = _family(f"{OURS}tabular.", DISCRETE, DISCRETE, engines=TABLE_ENGINES)
_tiled = _family(f"{OURS}linear.", LINEAR_INPUTS, DISCRETE, engines=TABLE_ENGINES)
_network = _family(f"{OURS}library:", NETWORK_INPUTS, DISCRETE, engines=LIBRARY_ENGINES)
_continuous = _family("stable_baselines3:", NETWORK_INPUTS, CONTINUOUS, engines=LIBRARY_ENGINES[:1])
_contrib = _family(
    "sb3_contrib:",
    NETWORK_INPUTS,
    DISCRETE,
    by=" (sb3-contrib)",
    package="sb3_contrib",
    extra="contrib",
    engines=LIBRARY_ENGINES[:1],
)
_planning = _family(f"{OURS}planning:", DISCRETE, DISCRETE)
_bandit = _family(f"{OURS}bandits.", DISCRETE, DISCRETE, for_bandits=True)
_mabwiser = _family(
    f"{OURS}mabwiser:",
    DISCRETE,
    DISCRETE,
    by=" (MABWiser)",
    for_bandits=True,
    package="mabwiser",
    extra="bandits",
)


ALGORITHMS: dict[str, AlgorithmEntry] = {
    "qlearning": _tabular("q_learning_and_sarsa:QLearning", "Q-learning on a table"),
    "sarsa": _tabular("q_learning_and_sarsa:SARSA", "SARSA on a table"),
    "expected_sarsa": _tabular("q_learning_and_sarsa:ExpectedSARSA", "Expected SARSA on a table"),
    "double_qlearning": _tabular(
        "q_learning_and_sarsa:DoubleQLearning", "double Q-learning on two tables"
    ),
    "n_step_sarsa": _tabular("n_step:NStepSARSA", "n-step SARSA on a table"),
    "n_step_tree_backup": _tabular("n_step:NStepTreeBackup", "n-step tree backup on a table"),
    "sarsa_lambda": _tabular("n_step:SARSALambda", "SARSA(lambda): traces on a table"),
    "q_lambda": _tabular("n_step:QLambda", "Watkins's Q(lambda): traces on a table"),
    "monte_carlo": _tabular("monte_carlo:MonteCarlo", "on-policy Monte Carlo on a table"),
    "off_policy_monte_carlo": _tabular(
        "monte_carlo:OffPolicyMonteCarlo", "off-policy Monte Carlo on a table"
    ),
    "dyna_q": _tabular("dyna:DynaQ", "Q-learning that plans on a learnt model"),
    "dyna_q_plus": _tabular("dyna:DynaQPlus", "Dyna-Q with a bonus for actions not tried for long"),
    "prioritized_sweeping": _tabular(
        "prioritized_sweeping:PrioritizedSweeping", "planning first where values change most"
    ),
    "r_max": _tabular("optimism:RMax", "planning that assumes the best of everything unknown"),
    "qlearning_ucb": _tabular("optimism:QLearningUCB", "Q-learning with upper confidence bounds"),
    "semi_gradient_sarsa": _tiled(
        "action_values:SemiGradientSARSA", "SARSA on tile coding (or a table)"
    ),
    "semi_gradient_q": _tiled(
        "action_values:SemiGradientQ", "Q-learning on tile coding (or a table)"
    ),
    "actor_critic": _tiled(
        "policy_gradients:ActorCritic", "one-step actor-critic on tiles or a table"
    ),
    "reinforce": _tiled(
        "policy_gradients:Reinforce", "REINFORCE on tiles or a table, with or without a baseline"
    ),
    "dqn": _network("DQN", "deep Q-network (Stable-Baselines3)"),
    "double_dqn": _network("DoubleDQN", "DQN with van Hasselt's target", engines=NETWORK_ENGINES),
    "deep_qlearning": _network(
        "DeepQLearning", "DQN of 2013: squared loss, no target network", engines=NETWORK_ENGINES
    ),
    "ppo": _network(
        "PPO", "proximal policy optimisation (Stable-Baselines3)", actions=POLICY_GRADIENT_OUTPUTS
    ),
    "a2c": _network(
        "A2C", "advantage actor-critic (Stable-Baselines3)", actions=POLICY_GRADIENT_OUTPUTS
    ),
    "sac": _continuous("SAC", "soft actor-critic (Stable-Baselines3)"),
    "td3": _continuous("TD3", "twin delayed policy gradient (Stable-Baselines3)"),
    "ddpg": _continuous("DDPG", "deep deterministic policy gradient (Stable-Baselines3)"),
    "qrdqn": _contrib("QRDQN", "quantile-regression DQN"),
    "tqc": _contrib("TQC", "truncated quantile critics", actions=CONTINUOUS),
    "crossq": _contrib(
        "CrossQ", "SAC without target networks", observations=VECTOR_INPUTS, actions=CONTINUOUS
    ),
    "trpo": _contrib("TRPO", "trust-region policy optimisation", actions=POLICY_GRADIENT_OUTPUTS),
    "ars": replace(
        _contrib("ARS", "augmented random search"),
        entry_point=f"{OURS}random_search:ARS",
        observations=VECTOR_INPUTS,
        actions=(*CONTINUOUS, *DISCRETE),
    ),
    "ppo_lstm": _contrib(
        "RecurrentPPO",
        "PPO with a memory",
        # sb3-contrib 2.9 fails on the other spaces.
        observations=("Box", "Discrete", "MultiBinary", "Dict"),
        actions=("Box", "Discrete", "MultiDiscrete"),
        has_memory=True,
    ),
    "ppo_mask": _contrib(
        "MaskablePPO",
        "PPO that is told which actions are valid",
        actions=("Discrete", "MultiDiscrete", "MultiBinary"),
        needs_masks=True,
    ),
    "value_iteration": _planning("ValueIteration", "planning: greedy in the optimal values"),
    "policy_iteration": _planning(
        "PolicyIteration", "planning: policies evaluated and improved in turn"
    ),
    "optimal": _planning("Optimal", "planning: the optimum under the time limit"),
    "random": AlgorithmEntry(
        "rl_yardstick.agents.planning:RandomAgent",
        "uniformly random actions",
        NETWORK_INPUTS,
        POLICY_GRADIENT_OUTPUTS,
    ),
    "angle": AlgorithmEntry(
        "rl_yardstick.agents.planning:AngleAgent",
        "CartPole: push to where the pole leans",
        CONTINUOUS,
        DISCRETE,
        observation_shape=(4,),
    ),
    "epsilon_greedy": _bandit("tables:EpsilonGreedy", "bandit: epsilon-greedy"),
    "boltzmann": _bandit("tables:Boltzmann", "bandit: softmax of the estimates"),
    "ucb": _bandit("rules:UCB", "bandit: upper confidence bounds"),
    "kl_ucb": _bandit("rules:KLUCB", "bandit: upper bounds by Kullback-Leibler divergence"),
    "gradient_bandit": _bandit("rules:GradientBandit", "bandit: gradient on preferences"),
    "exp3": _bandit("rules:Exp3", "bandit: exponential weights against an adversary"),
    "thompson": _bandit("rules:Thompson", "bandit: Thompson sampling"),
    "linucb": _bandit(
        "linear:LinUCB",
        "contextual bandit: linear upper confidence bounds",
        observations=LINEAR_INPUTS,
    ),
    "lin_thompson": _bandit(
        "linear:LinThompson",
        "contextual bandit: linear Thompson sampling",
        observations=LINEAR_INPUTS,
    ),
    "lin_epsilon_greedy": _bandit(
        "linear:LinEpsilonGreedy",
        "contextual bandit: linear, epsilon-greedy",
        observations=LINEAR_INPUTS,
    ),
    "mabwiser_epsilon_greedy": _mabwiser("MABWiserEpsilonGreedy", "bandit: epsilon-greedy"),
    "mabwiser_ucb1": _mabwiser("MABWiserUCB1", "bandit: UCB1"),
    "mabwiser_thompson": _mabwiser("MABWiserThompson", "bandit: Thompson sampling"),
    "mabwiser_linucb": _mabwiser(
        "MABWiserLinUCB", "contextual bandit: LinUCB", observations=LINEAR_INPUTS
    ),
}


BY_VALUE: dict[str, type] = {}  # classes that `name_of` has registered


def register(name: str, entry_point: str, **fields: Any) -> None:
    """Add an agent of your own to the registry under a short name; nothing is imported.

    ``entry_point`` is its class as ``"module:Class"``, ``fields`` are attributes of
    `AlgorithmEntry`. Raises ValueError if the name is that of another class.
    """
    for role in {"observations", "actions"} & fields.keys():
        names = fields[role]
        fields[role] = (names,) if isinstance(names, str) else tuple(names)
    entry = AlgorithmEntry(entry_point, **{"summary": entry_point.rpartition(":")[2], **fields})
    if ALGORITHMS.setdefault(name, entry) != entry:
        raise ValueError(f"there is an agent {name} already: give {entry_point} another name")


def add_class(name: str, cls: Any) -> None:
    """Put a class into the registry; ValueError if it is none that can be trained."""
    if fault := fault_of(cls):
        raise ValueError(f"{name} {fault}")
    takes = parameters_of(cls)
    seen = DISCRETE if "n_states" in takes else NETWORK_INPUTS
    done = DISCRETE if "n_actions" in takes else POLICY_GRADIENT_OUTPUTS
    kinds: Any = (seen, done) if is_plain(cls) else ()
    module, _, own = name.rpartition(".")
    ALGORITHMS[name] = AlgorithmEntry(f"{module or '__main__'}:{own}", own, *kinds)


def name_of(cls: type) -> str:
    """Register a class itself, such as one of a notebook's cell, and return the agent's name.

    It replaces one of the same name that was registered here. Processes that train in parallel get
    it by value. Raises ValueError if it cannot be trained, or a shipped agent has its name.
    """
    name, module = (getattr(cls, key, str(cls)) for key in ("__name__", "__module__"))
    name = name if module == "__main__" else f"{module}.{name}"
    taken = {known.lower() for known in ALGORITHMS if known not in BY_VALUE}
    if "." not in name and name.lower() in taken:
        raise ValueError(f"there is an agent {name.lower()} already: give the class another name")
    add_class(name, cls)
    BY_VALUE[name] = cls
    return name


def load_algorithm(name: str) -> type[BaseAlgorithm]:
    """Import the class of the agent ``name``; for a plain class, the algorithm that trains it.

    Raises:
        KeyError: if there is no agent of that name.
        ModuleNotFoundError: if the optional package that it needs is missing.
        ValueError: if there is no such class, or it cannot be trained.
    """
    entry_point = ALGORITHMS[name].entry_point
    module_name, class_name = entry_point.split(":")
    found: Any = BY_VALUE.get(name) or getattr(
        importlib.import_module(module_name), class_name, None
    )
    if fault := "does not exist" if found is None else fault_of(found):
        raise ValueError(f"{name} is registered as {entry_point}, which {fault}")
    if is_plain(found):
        from rl_yardstick.agents.plain import algorithm_of

        found = algorithm_of(found)
    return found  # type: ignore[no-any-return]


def fitting_algorithms(
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    bandit: bool = False,
    masks: bool = False,
) -> list[str]:
    """Names of the agents that can work with these spaces, in the order of the registry.

    ``bandit``: whether the environment is one; ``masks``: whether it provides action masks.
    """
    return [
        name
        for name, entry in ALGORITHMS.items()
        if bandit >= entry.for_bandits
        and masks >= entry.needs_masks
        and not entry.misfit(observation_space, action_space)
    ]

"""The table of agents: a name, where the class lives, and what it can work with."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium import spaces

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

DISCRETE = ("Discrete",)
LINEAR_INPUTS = ("Box", "Discrete")
NETWORK_INPUTS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary", "Dict")
POLICY_GRADIENT_OUTPUTS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")
CONTINUOUS = ("Box",)
VECTOR_INPUTS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")


@dataclass(frozen=True)
class AlgorithmEntry:
    """One agent that can be trained.

    Attributes:
        entry_point: where the class lives, as ``"module:Class"``; imported only when needed.
        summary: what the agent is, in a few words.
        observations: names of the Gymnasium spaces that it can observe.
        actions: names of the Gymnasium spaces that it can act in.
        observation_shape: the one observation shape that it understands, or None for any.
        for_bandits: whether it looks no further than the next reward.
        needs_masks: whether the environment must say which actions are valid (``action_masks()``).
        package: the import name of an optional package that it needs, or None.
        extra: the extra of this distribution that installs that package.
    """

    entry_point: str
    summary: str
    observations: tuple[str, ...]
    actions: tuple[str, ...]
    observation_shape: tuple[int, ...] | None = None
    for_bandits: bool = False
    needs_masks: bool = False
    package: str | None = None
    extra: str | None = None

    @property
    def family(self) -> str:
        """The folder of `agents` that the class lives in; empty where it is in none."""
        package, *folders = self.entry_point.partition(":")[0].split(".")
        return folders[0] if package == "agents" and len(folders) > 1 else ""

    @property
    def is_installed(self) -> bool:
        """Whether the package that the agent needs is there."""
        return self.package is None or importlib.util.find_spec(self.package) is not None

    def misfit(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> str:
        """Say why the agent cannot work with these spaces; empty where it can."""
        for space, known, role in (
            (observation_space, self.observations, "observes"),
            (action_space, self.actions, "acts in"),
        ):
            if type(space).__name__ not in known:
                return f"it {role} {' or '.join(known)} spaces, not {space}"
            # The one-hot encoding of Stable-Baselines3 and every table count from zero.
            if isinstance(space, spaces.Discrete) and space.start != 0:
                return f"it needs Discrete spaces that start at 0, not {space}"
        shape = self.observation_shape
        if shape is not None and observation_space.shape != shape:
            return f"it needs observations of shape {shape}, not {observation_space.shape}"
        return ""

    def env_misfit(self, env: gym.Env[Any, Any]) -> str:
        """Say why the agent cannot work with the environment; empty where it can."""
        if self.for_bandits and not is_bandit(env):
            return "it is for bandits, where a pull changes nothing but its own reward"
        if self.needs_masks and not has_masks(env):
            return "it needs to be told which actions are valid, by a method action_masks()"
        return self.misfit(env.observation_space, env.action_space)


def is_bandit(env: gym.Env[Any, Any]) -> bool:
    """Whether the environment is one of `envs.bandits`."""
    from envs.bandits import Bandit

    return isinstance(env.unwrapped, Bandit)


def has_masks(env: gym.Env[Any, Any]) -> bool:
    """Whether the environment, or a wrapper of it, says which actions are valid."""
    return env.has_wrapper_attr("action_masks")


def _tabular(entry_point: str, summary: str) -> AlgorithmEntry:
    return AlgorithmEntry(f"agents.tabular.{entry_point}", summary, DISCRETE, DISCRETE)


def _deep(entry_point: str, summary: str, actions: tuple[str, ...] = DISCRETE) -> AlgorithmEntry:
    return AlgorithmEntry(entry_point, summary, NETWORK_INPUTS, actions)


def _contrib(
    entry_point: str,
    summary: str,
    actions: tuple[str, ...],
    observations: tuple[str, ...] = NETWORK_INPUTS,
    *,
    needs_masks: bool = False,
) -> AlgorithmEntry:
    return AlgorithmEntry(
        entry_point,
        f"{summary} (sb3-contrib)",
        observations,
        actions,
        needs_masks=needs_masks,
        package="sb3_contrib",
        extra="contrib",
    )


def _bandit(entry_point: str, summary: str) -> AlgorithmEntry:
    entry_point = f"agents.bandits.{entry_point}"
    return AlgorithmEntry(entry_point, summary, DISCRETE, DISCRETE, for_bandits=True)


def _linear(name: str, summary: str) -> AlgorithmEntry:
    return AlgorithmEntry(
        f"agents.bandits.linear_bandits:{name}", summary, LINEAR_INPUTS, DISCRETE, for_bandits=True
    )


def _mabwiser(name: str, summary: str, observations: tuple[str, ...] = DISCRETE) -> AlgorithmEntry:
    return AlgorithmEntry(
        f"agents.mabwiser.mabwiser_agents:{name}",
        f"{summary} (MABWiser)",
        observations,
        DISCRETE,
        for_bandits=True,
        package="mabwiser",
        extra="bandits",
    )


ALGORITHMS: dict[str, AlgorithmEntry] = {
    "qlearning": _tabular("q_learning:QLearning", "Q-learning on a table"),
    "sarsa": _tabular("sarsa:SARSA", "SARSA on a table"),
    "expected_sarsa": _tabular("expected_sarsa:ExpectedSARSA", "Expected SARSA on a table"),
    "double_qlearning": _tabular(
        "double_q_learning:DoubleQLearning", "double Q-learning on two tables"
    ),
    "dqn": _deep("stable_baselines3:DQN", "deep Q-network (Stable-Baselines3)"),
    "double_dqn": _deep("agents.deep:DoubleDQN", "DQN with van Hasselt's target"),
    "deep_qlearning": _deep(
        "agents.deep:DeepQLearning", "DQN of 2013: squared loss, no target network"
    ),
    "ppo": _deep(
        "stable_baselines3:PPO",
        "proximal policy optimisation (Stable-Baselines3)",
        POLICY_GRADIENT_OUTPUTS,
    ),
    "a2c": _deep(
        "stable_baselines3:A2C",
        "advantage actor-critic (Stable-Baselines3)",
        POLICY_GRADIENT_OUTPUTS,
    ),
    "sac": _deep("stable_baselines3:SAC", "soft actor-critic (Stable-Baselines3)", CONTINUOUS),
    "td3": _deep(
        "stable_baselines3:TD3", "twin delayed policy gradient (Stable-Baselines3)", CONTINUOUS
    ),
    "ddpg": _deep(
        "stable_baselines3:DDPG",
        "deep deterministic policy gradient (Stable-Baselines3)",
        CONTINUOUS,
    ),
    "qrdqn": _contrib("sb3_contrib:QRDQN", "quantile-regression DQN", DISCRETE),
    "tqc": _contrib("sb3_contrib:TQC", "truncated quantile critics", CONTINUOUS),
    "crossq": _contrib(
        "sb3_contrib:CrossQ", "SAC without target networks", CONTINUOUS, VECTOR_INPUTS
    ),
    "trpo": _contrib(
        "sb3_contrib:TRPO", "trust-region policy optimisation", POLICY_GRADIENT_OUTPUTS
    ),
    "ars": _contrib(
        "agents.random_search:ARS",
        "augmented random search",
        (*CONTINUOUS, *DISCRETE),
        VECTOR_INPUTS,
    ),
    "ppo_lstm": _contrib(
        "sb3_contrib:RecurrentPPO",
        "PPO with a memory",
        # As it is in sb3-contrib 2.9, which fails on the other spaces.
        ("Box", "Discrete", "MultiDiscrete"),
        ("Box", "Discrete", "MultiBinary", "Dict"),
    ),
    "ppo_mask": _contrib(
        "sb3_contrib:MaskablePPO",
        "PPO that is told which actions are valid",
        ("Discrete", "MultiDiscrete", "MultiBinary"),
        needs_masks=True,
    ),
    "value_iteration": AlgorithmEntry(
        "agents.planning:ValueIteration",
        "planning: greedy in the optimal values",
        DISCRETE,
        DISCRETE,
    ),
    "optimal": AlgorithmEntry(
        "agents.planning:Optimal",
        "planning: the optimum under the time limit",
        DISCRETE,
        DISCRETE,
    ),
    "random": AlgorithmEntry(
        "agents.reference:RandomAgent",
        "uniformly random actions",
        NETWORK_INPUTS,
        POLICY_GRADIENT_OUTPUTS,
    ),
    "angle": AlgorithmEntry(
        "agents.reference:AngleAgent",
        "CartPole: push to where the pole leans",
        ("Box",),
        DISCRETE,
        observation_shape=(4,),
    ),
    "epsilon_greedy": _bandit("value_bandits:EpsilonGreedy", "bandit: epsilon-greedy"),
    "boltzmann": _bandit("value_bandits:Boltzmann", "bandit: softmax of the estimates"),
    "ucb": _bandit("ucb:UCB", "bandit: upper confidence bounds"),
    "kl_ucb": _bandit("kl_ucb:KLUCB", "bandit: upper bounds by the divergence of coins"),
    "gradient_bandit": _bandit("gradient_bandit:GradientBandit", "bandit: gradient on preferences"),
    "exp3": _bandit("exp3:Exp3", "bandit: exponential weights against an adversary"),
    "thompson": _bandit("thompson:Thompson", "bandit: Thompson sampling"),
    "linucb": _linear("LinUCB", "contextual bandit: linear upper confidence bounds"),
    "lin_thompson": _linear("LinThompson", "contextual bandit: linear Thompson sampling"),
    "lin_epsilon_greedy": _linear("LinEpsilonGreedy", "contextual bandit: linear, epsilon-greedy"),
    "mabwiser_epsilon_greedy": _mabwiser("MABWiserEpsilonGreedy", "bandit: epsilon-greedy"),
    "mabwiser_ucb1": _mabwiser("MABWiserUCB1", "bandit: UCB1"),
    "mabwiser_thompson": _mabwiser("MABWiserThompson", "bandit: Thompson sampling"),
    "mabwiser_linucb": _mabwiser("MABWiserLinUCB", "contextual bandit: LinUCB", LINEAR_INPUTS),
}


def load_algorithm(name: str) -> type[BaseAlgorithm]:
    """Import the class of the agent ``name``.

    Raises:
        KeyError: if there is no agent of that name.
        ModuleNotFoundError: if the optional package that it needs is missing.
    """
    module_name, class_name = ALGORITHMS[name].entry_point.split(":")
    algorithm: type[BaseAlgorithm] = getattr(importlib.import_module(module_name), class_name)
    return algorithm


def fitting_algorithms(
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    bandit: bool = False,
    masks: bool = False,
) -> list[str]:
    """Names of the agents that can work with these spaces, in the order of the table.

    Args:
        observation_space: what is observed.
        action_space: what can be done.
        bandit: whether the environment is a bandit.
        masks: whether the environment says which actions are valid.
    """
    return [
        name
        for name, entry in ALGORITHMS.items()
        if bandit >= entry.for_bandits
        and masks >= entry.needs_masks
        and not entry.misfit(observation_space, action_space)
    ]

"""The arguments that tabular agents share, for constructors that hand them on."""

from __future__ import annotations

from typing import Any, Literal

from stable_baselines3.common.type_aliases import Schedule

from agents.common.signatures import CommonArguments, ExplorationDecay, TieBreaking
from agents.compiled.engine_choice import EngineChoice
from agents.compiled.learning_algorithm import StepSize

ExplorationStrategy = Literal["epsilon_greedy", "boltzmann", "gaussian_noise"]


class TabularArguments(CommonArguments, total=False):
    """What the constructor of every tabular agent takes; see `TabularAlgorithm`."""

    learning_rate: StepSize
    gamma: float
    exploration: ExplorationStrategy
    exploration_fraction: float
    exploration_initial_eps: float
    exploration_final_eps: float
    exploration_decay: ExplorationDecay
    temperature: float | Schedule
    noise_std: float | Schedule
    tie_breaking: TieBreaking
    initial_q: float
    initial_q_std: float
    skip_terminal_update: bool
    engine: EngineChoice
    policy_kwargs: dict[str, Any] | None

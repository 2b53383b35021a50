"""The words that arguments of the tabular agents can be, and the checks of all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, cast, get_args

from gymnasium import spaces

from agents.common.step_sizes import SAMPLE_AVERAGE

if TYPE_CHECKING:
    from agents.tabular.base import TabularAlgorithm

ExplorationStrategy = Literal["epsilon_greedy", "boltzmann", "gaussian_noise"]
ExplorationDecay = Literal["constant", "linear", "exponential"]
TieBreaking = Literal["random", "first"]
EngineChoice = Literal["auto", "compiled", "interpreted"]


def check_arguments(agent: TabularAlgorithm) -> None:
    """Refuse what does not work out, before anything is made of it.

    Raises:
    ValueError: naming the argument and what it must be.
    """
    for name, space in (
        ("observations", agent.observation_space),
        ("actions", agent.action_space),
    ):
        if not isinstance(space, spaces.Discrete) or space.start != 0:
            raise ValueError(
                f"{type(agent).__name__} needs {name} in a Discrete space that starts at 0, "
                f"not {space}"
            )
    for name, options in (
        ("exploration", ExplorationStrategy),
        ("exploration_decay", ExplorationDecay),
        ("tie_breaking", TieBreaking),
        ("engine", EngineChoice),
    ):
        if getattr(agent, name) not in get_args(options):
            raise ValueError(
                f"{name} must be one of {', '.join(get_args(options))}, "
                f"not {getattr(agent, name)!r}"
            )
    for name in (
        "gamma",
        "exploration_fraction",
        "exploration_initial_eps",
        "exploration_final_eps",
    ):
        if not 0 <= getattr(agent, name) <= 1:
            raise ValueError(f"{name} must lie between 0 and 1, not {getattr(agent, name)}")
    if isinstance(agent.temperature, int | float) and agent.temperature <= 0:
        raise ValueError(f"temperature must be above 0, not {agent.temperature}")
    if isinstance(cast(Any, agent.learning_rate), str) and not agent.averages_samples:
        raise ValueError(
            f"learning_rate must be a number, a schedule or {SAMPLE_AVERAGE!r}, "
            f"not {agent.learning_rate!r}"
        )

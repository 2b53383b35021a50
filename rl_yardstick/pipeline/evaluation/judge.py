"""Chooses how a training's agent is evaluated: exactly, over histories, or by episodes."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm

from rl_yardstick.pipeline.environments import make_evaluation_env
from rl_yardstick.pipeline.evaluation.exact import (
    ExactEvaluator,
    discount_note,
    evaluator_of,
    model_refusal,
)
from rl_yardstick.pipeline.evaluation.histories import (
    BY_HISTORIES,
    HistoryEvaluator,
    world_of_memory,
)
from rl_yardstick.pipeline.evaluation.policies import has_memory, why_not_exact
from rl_yardstick.pipeline.evaluation.sampled import (
    Evaluation,
    SampledEvaluator,
    n_environments,
    takes_batches,
)
from rl_yardstick.pipeline.evaluation.value_maps import map_refusal
from rl_yardstick.pipeline.evaluation.yardstick import Yardstick
from rl_yardstick.pipeline.spec import TrainSpec


class Judge:
    """Evaluates one agent, and tells why it is judged as it is.

    Args:
        spec: the training.
        agent: the agent, on its training environments.
        console: where remarks are printed.

    Attributes:
        exact: the exact evaluator; None if episodes are sampled or histories followed.
        env: the evaluation environments.
        evaluator: maps the agent to an `Evaluation`.
        refusal: why the environment's own model was rejected; None if it was not.
    """

    def __init__(self, spec: TrainSpec, agent: BaseAlgorithm, console: Console) -> None:
        self.spec, self.console = spec, console
        self.exact, yardstick = self._exact(agent)
        world = None if self.exact is not None else world_of_memory(spec, agent)
        n_envs = 1
        if self.exact is None and takes_batches(agent):
            n_envs = n_environments(spec.n_eval_envs, spec.eval_episodes)
        self.env = make_evaluation_env(spec, n_envs)
        self.evaluator: Any = self.exact
        if world is not None:
            self._say(BY_HISTORIES)
            self.evaluator = HistoryEvaluator(spec, self.env, world)
        elif self.exact is None:
            self.evaluator = SampledEvaluator(spec, self.env, yardstick)
        self.yardstick: Yardstick | None = None  # of the final evaluation
        self.refusal = None if self.exact is not None else model_refusal(spec)

    def at_the_end(self, agent: BaseAlgorithm) -> Evaluation:
        """The final evaluation, with more episodes or further exact returns."""
        found: Evaluation = self.evaluator.at_the_end(agent)
        self.yardstick = found.yardstick
        return found

    def _say(self, line: str) -> None:
        self.console.print(line, style="dim", markup=False, highlight=False)

    def _exact(self, agent: BaseAlgorithm) -> tuple[ExactEvaluator | None, Yardstick | None]:
        """The exact evaluator if the agent permits it, or else the known yardstick."""
        spec = self.spec
        exact = None if has_memory(agent) else evaluator_of(spec)
        if exact is None:
            return None, None
        obstacle = exact.obstacle(agent)
        if reason := obstacle or why_not_exact(agent, exact.observations):
            self._say(f"evaluations are sampled, not exact: {reason}")
            # A user's agent that cannot be queried in all states may have memory.
            if exact.scale is not None and not obstacle:
                return None, exact.scale.yardstick(with_memory=True)
            return None, exact.yardstick
        notes = [map_refusal(exact), None if exact.scale is None else exact.scale.note]
        gamma = getattr(agent, "gamma", None)
        is_bandit = agent.env is not None and agent.env.has_attr("n_arms")
        if not self.console.quiet and isinstance(gamma, float) and not is_bandit:
            notes.append(discount_note(spec, exact, gamma))
        for note in filter(None, notes):
            self._say(note)
        return exact, None

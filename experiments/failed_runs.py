"""What the agents of failed runs do instead, and what to try first: once for each agent."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from experiments.analysis import StudyAnalysis
from experiments.child_processes import do_aside
from experiments.planned_runs import PlannedRun
from experiments.study_results import StudyResults
from pipeline.errors import UserError
from pipeline.evaluation import FAILED, NEARLY_ALL

# Agents of an environment that advice is given on, each of which is loaded and asked.
MOST_TOLD = 4


@dataclass(frozen=True)
class _Failure:
    """The runs of an agent that failed on an environment, told by the first of them."""

    agent: str
    n_failed: int
    n_runs: int
    first: PlannedRun

    def sentence(self, found: tuple[str, str | None]) -> str:
        """What the first one's agent does instead, and what to try first."""
        of = f"{self.n_failed} of {self.n_runs} runs" if self.n_runs > 1 else "its run"
        seed = f"; seed {self.first.seed}" if self.n_failed > 1 else ""
        instead, try_first = found
        then = f"; try first: {try_first}" if try_first else ""
        return f"{self.agent} failed in {of}{seed}: {instead}{then}."


def with_advice(analysis: StudyAnalysis) -> StudyAnalysis:
    """The analysis with sentences on runs that failed, where something can be said of them."""
    failures = [_failures(analysis.results, one.environment) for one in analysis.environments]
    asked = [failure.first for several in failures for failure in several[:MOST_TOLD]]
    answers = iter(do_aside(advice_on, asked) if asked else ())
    environments = []
    for one, several in zip(analysis.environments, failures, strict=True):
        told, more = several[:MOST_TOLD], several[MOST_TOLD:]
        found = [(failure, next(answers)) for failure in told]
        advice = [failure.sentence(answer) for failure, answer in found if answer is not None]
        if more:
            names = ", ".join(f"{each.agent} ({each.n_failed} of {each.n_runs})" for each in more)
            advice.append(f"Runs of {len(more)} more agents failed: {names}.")
        environments.append(replace(one, advice=tuple(advice)))
    return replace(analysis, environments=tuple(environments))


def _failures(results: StudyResults, environment: str) -> list[_Failure]:
    table = results.summary[results.summary["environment"] == environment]
    runs = {
        (run.agent, run.seed): run for run in results.finished if run.environment == environment
    }
    failures = []
    for agent, rows in table.groupby("agent", sort=False):
        has_failed = rows["score"].astype(float) < FAILED
        # Such a policy may never end an episode; the advice looks whether it does.
        has_failed |= rows["success_rate"].astype(float) < 1 - NEARLY_ALL
        failed = rows[has_failed & rows["exact"].astype(bool)]
        if not failed.empty:
            first = runs[str(agent), int(failed["seed"].min())]
            failures.append(_Failure(str(agent), len(failed), len(rows), first))
    return failures


def advice_on(runs: Sequence[PlannedRun]) -> list[tuple[str, str | None] | None]:
    """What the agent of each run does instead, and what to try first; None for nothing to say."""
    return [_advice_on(run) for run in runs]


def _advice_on(planned: PlannedRun) -> tuple[str, str | None] | None:
    from pipeline.evaluation.advice import advice
    from pipeline.evaluation.exact import evaluator_of
    from pipeline.models.load import load_model

    run, spec = planned.run, planned.spec
    with suppress(UserError, OSError):
        evaluator = evaluator_of(spec)
        if evaluator is None:
            return None
        agent = load_model(spec.algo, run.model_path, modules=spec.user_modules, device="cpu")
        if evaluator.obstacle(agent):
            return None
        n_steps = int(run.read_info()["n_timesteps"])
        found = advice(spec, agent, evaluator, evaluator(agent), n_steps)
        return None if found is None else (found.instead, found.try_first)
    return None

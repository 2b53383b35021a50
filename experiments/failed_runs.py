"""What the agents of failed runs do instead, and what to try first: once for each agent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

from experiments.analysis import StudyAnalysis
from experiments.child_processes import do_aside
from experiments.planned_runs import PlannedRun
from experiments.study_results import StudyResults
from pipeline.errors import UserError
from pipeline.evaluation import FAILED, NEARLY_ALL

# Agents of an environment that advice is given on, each of which is loaded and asked.
MOST_TOLD = 4


def with_advice(analysis: StudyAnalysis) -> StudyAnalysis:
    """The analysis with sentences on runs that failed, where something can be said of them."""
    results = analysis.results
    return replace(
        analysis,
        environments=tuple(
            replace(one, advice=tuple(_sentences(results, one.environment)))
            for one in analysis.environments
        ),
    )


def _sentences(results: StudyResults, environment: str) -> Iterator[str]:
    table = results.summary[results.summary["environment"] == environment]
    runs = {
        (run.agent, run.seed): run for run in results.finished if run.environment == environment
    }
    n_told, more = 0, []
    for agent, rows in table.groupby("agent", sort=False):
        has_failed = rows["score"].astype(float) < FAILED
        # Such a policy may never end an episode; the advice looks whether it does.
        has_failed |= rows["success_rate"].astype(float) < 1 - NEARLY_ALL
        failed = rows[has_failed & rows["exact"].astype(bool)]
        if failed.empty:
            continue
        if n_told == MOST_TOLD:
            more.append(f"{agent} ({len(failed)} of {len(rows)})")
            continue
        n_told += 1
        seed = int(failed["seed"].min())
        found = do_aside(advice_on, runs[str(agent), seed])
        if found is not None:
            of = f"{len(failed)} of {len(rows)} runs" if len(rows) > 1 else "its run"
            first = f"; seed {seed}" if len(failed) > 1 else ""
            instead, try_first = found
            then = f"; try first: {try_first}" if try_first else ""
            yield f"{agent} failed in {of}{first}: {instead}{then}."
    if more:
        yield f"Runs of {len(more)} more agents failed: {', '.join(more)}."


def advice_on(planned: PlannedRun) -> tuple[str, str | None] | None:
    """What a run's agent does instead and what to try first; None where nothing can be said."""
    from pipeline.evaluation.advice import advice
    from pipeline.evaluation.exact import exact_evaluator
    from pipeline.models.model_loading import load_model

    run, spec = planned.run, planned.spec
    with suppress(UserError, OSError):
        evaluator = exact_evaluator(spec)
        if evaluator is None:
            return None
        agent = load_model(spec.algo, run.model_path, modules=spec.user_modules, device="cpu")
        if evaluator.obstacle(agent):
            return None
        n_steps = int(run.read_info()["n_timesteps"])
        found = advice(spec, agent, evaluator, evaluator(agent), n_steps)
        return None if found is None else (found.instead, found.try_first)
    return None

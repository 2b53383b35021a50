"""The few lines before and after a training run."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from agents import ALGORITHMS
from commands.parsing import called_as
from commands.terminal import print_rows
from pipeline.errors import UserError
from pipeline.module_records import as_flag
from pipeline.runs import FINISHED, Run, numbered_runs
from pipeline.settings.values import parse_schedule
from pipeline.train_spec import TrainSpec

if TYPE_CHECKING:
    from pipeline.evaluation.sampled import Evaluation
    from pipeline.preparation import Training
    from pipeline.pull_recording import PullSummary
    from pipeline.training import Outcome

_LONGEST_SETTING = 200
_NOTES = {"train_env_kwargs": "in training alone", "train_env_wrapper": "in training alone"}


def describe(evaluation: Evaluation) -> str:
    """An evaluation in a few words."""
    text = f"return {evaluation.mean_return:.2f}"
    if evaluation.is_exact:
        text += " (exact)"
    else:
        text += f" ± {evaluation.std_return:.2f} over {episodes(len(evaluation.returns))}"
    if evaluation.success_rate is not None:
        text += f", success {evaluation.success_rate:.1%}"
    measured = describe_measured(evaluation)
    return f"{text}, {measured}" if measured else text


def describe_measured(evaluation: Evaluation) -> str:
    """How the return stands to the optimum; empty where that is neither known nor bracketed."""
    yardstick, value = evaluation.yardstick, evaluation.mean_return
    if yardstick is None:
        return ""
    optimum, score = f"optimum {yardstick.optimum:.2f}", f"score {yardstick.score(value):.2f}"
    if yardstick.at_least is not None:
        optimum = f"optimum between {yardstick.at_least:.2f} and {yardstick.optimum:.2f}"
        most = f"{yardstick.lower_end.score(value):.2f}"
        score += f" to {most} (bracketed)" if not score.endswith(most) else " (bracketed)"
    text = f"{optimum}, best random or constant policy {yardstick.baseline:.2f}, {score}"
    if evaluation.beats_optimum:
        text += (
            ". THIS IS MORE THAN ANY POLICY CAN REACH: the environment is not the one that the "
            "bracket is of, or the bracket is wrong"
        )
    return text


def episodes(n: int) -> str:
    """So many episodes."""
    return f"{n:,} episode{'s' if n != 1 else ''}"


def describe_pulls(pulls: PullSummary) -> str:
    """The pulls of a training in a few words."""
    from pipeline.pull_recording import LAST_PULLS

    if pulls.regret is not None:
        last = min(LAST_PULLS, pulls.n_pulls)
        return (
            f"{pulls.regret:,.2f} over {pulls.n_pulls:,} pulls; "
            f"a best arm in {pulls.optimal:.0%} of the last {last}"
        )
    if pulls.reward is None:
        return f"not known: none of {pulls.n_pulls:,} pulls is in the log"
    return (
        f"not known; reward {pulls.reward:.4f} a pull over the {pulls.n_matched:,} "
        f"of {pulls.n_pulls:,} that are in the log"
    )


def print_header(console: Console, spec: TrainSpec) -> None:
    """Say what is about to be trained, and with which hyperparameters."""
    budget = spec.hyperparams.n_timesteps or spec.hyperparams.n_episodes or 0
    unit = "steps" if spec.hyperparams.n_timesteps else "episodes"
    agent, environment = Text(spec.algo, "bold"), Text(spec.env_id, "bold")
    console.print(
        Text.assemble(agent, " on ", environment, f", seed {spec.seed}, {budget:,} {unit}")
    )
    origins = spec.origins or {}
    settings = {
        key: f"{key}={_brief(value)}"
        for key, value in spec.saved_hyperparams.items()
        if key != "policy" or _is_choice(spec.algo, str(value))
    }
    explained = {
        key: "; ".join(filter(None, (_NOTES.get(key), _schedule_in_words(value), origins.get(key))))
        for key, value in spec.saved_hyperparams.items()
    }
    plain = [text for key, text in settings.items() if not explained[key]]
    lines = [f"{text} ({explained[key]})" for key, text in settings.items() if explained[key]]
    for line in ["  ".join(plain), *lines] if plain else lines:
        console.print(line, style="dim", highlight=False)


def _is_choice(algo: str, policy: str) -> bool:
    """Whether an agent has other policies too: tables and bandits of this project have one each."""
    is_ours = algo in ALGORITHMS and ALGORITHMS[algo].entry_point.startswith("agents.")
    return not is_ours or policy.startswith(("Mlp", "Cnn", "MultiInput"))


def _schedule_in_words(value: object) -> str:
    """What ``exp_0.3_0.05`` means; empty for what is no schedule."""
    if not isinstance(value, str):
        return ""
    try:
        found = parse_schedule(value, "")
    except UserError:
        return ""
    moves = "falls" if found.end < found.start else "rises"
    how = "linearly" if found.kind == "linear" else "exponentially"
    return f"{moves} {how} from {found.start:g} to {found.end:g}"


def print_engine(console: Console, training: Training) -> None:
    """Say on which engine it will run, and what that takes."""
    from commands.engine_lines import training_line
    from pipeline.engine_outlook import engine_outlook

    model, callback = training.model, training.callback
    line = training_line(engine_outlook(model, training.spec, [callback]), model, callback)
    if line:
        print_line(console, f"engine  {line}")


def print_line(console: Console, line: str) -> None:
    """Say something beside the figures, in one line however long it is."""
    console.print(line, style="dim", highlight=False, soft_wrap=True)


def print_refusal(console: Console, refusal: str | None) -> None:
    """Say why the environment's own model is not used, where that is so."""
    if refusal is not None:
        console.print(f"{refusal}; figures are sampled", highlight=False, soft_wrap=True)


def print_result(console: Console, training: Training, outcome: Outcome) -> None:
    """Say what came out, and what to try first if the agent has failed."""
    print_outcome(console, training.spec, outcome)
    if outcome.final is not None and not console.quiet:
        _print_advice(console, training, outcome.final, outcome.n_steps)


def print_outcome(console: Console, spec: TrainSpec, outcome: Outcome) -> None:
    """Say what came out and where the files lie."""
    taken = outcome.taken.cpu_seconds
    speed = outcome.n_steps / max(taken, 1e-9)
    done = "trained" if outcome.state == FINISHED else "interrupted"
    text = f"{outcome.n_steps:,} steps in {taken:.1f} s of processor time ({speed:,.0f} steps/s)"
    rows = [(done, text)]
    if outcome.engine:
        rows.append(("engine", outcome.engine))
    if outcome.pulls is not None:
        rows.append(("regret", describe_pulls(outcome.pulls)))
    if outcome.final is not None:
        rows.append(("final", describe(outcome.final)))
    if outcome.best_return is not None:
        over = f" over {episodes(outcome.best_episodes)}" if outcome.best_episodes else ""
        best = f"return {outcome.best_return:.2f}{over}, first at step {outcome.best_timesteps:,}"
        rows.append(("best", best))
    if outcome.final is not None:
        rows.append(("tests", _describe_evaluations(outcome)))
    rows.append(("files", str(outcome.run.path)))
    table = Table.grid(padding=(0, 2))
    for row in rows:
        table.add_row(*row)
    print_rows(console, table)
    # On one line, however long: it is there to be copied.
    width = max(len(label) for label, _ in rows) + 2
    command = f"{'watch':<{width}}{watch_command(spec, outcome.run)}"
    console.print(command, highlight=False, soft_wrap=True)


def _print_advice(console: Console, training: Training, final: Evaluation, n_steps: int) -> None:
    """Say what an agent that failed does instead, and what to try first."""
    from pipeline.evaluation.advice import advice

    evaluator = training.evaluation.evaluator
    found = advice(training.spec, training.model, evaluator, final, n_steps)
    if found is None:
        return
    console.print(f"instead  {found.instead}", highlight=False, soft_wrap=True)
    more = "docs/not-learning.md"
    tried = f"try      {found.try_first}; more: {more}" if found.try_first else f"more     {more}"
    console.print(tried, highlight=False, soft_wrap=True)


def _describe_evaluations(outcome: Outcome) -> str:
    """What all evaluations have taken."""
    taken = f"{outcome.evaluating.cpu_seconds:.1f} s of processor time"
    if not outcome.evaluation_steps:
        return f"exact, without playing; {taken}"
    share = outcome.evaluation_steps / max(outcome.n_steps, 1)
    return f"{outcome.evaluation_steps:,} steps beside training ({share:.0%} of it); {taken}"


@contextmanager
def telling_what_is_kept(run: Run) -> Iterator[None]:
    """Let the line about a run that fails end with the models that its folder keeps.

    Raises:
        UserError: that line; as it is where no folder is left.
    """
    try:
        yield
    except UserError as error:
        if not run.path.exists():
            raise
        best, checkpoints = run.best_model_path, len(run.checkpoints())
        kept = [best.name] if best.exists() else []
        kept += [f"{checkpoints:,} checkpoint{'s'[: checkpoints > 1]}"] if checkpoints else []
        models = " and ".join(kept) or "no model"
        raise UserError(f"{error}; {run.path} keeps {models}") from error


def watch_command(spec: TrainSpec, run: Run) -> str:
    """The command that plays the agent of a run, as it can be typed where the run was begun."""
    command: list[str] = []
    numbers = [number for number, _ in numbered_runs(run.path.parent, run.env_name)]
    if numbers.count(run.number) > 1:  # told apart by their unique suffixes alone
        command.append(str(run.path))
    else:
        command += ["--algo", spec.algo, "--env", spec.env_id]
        command += [] if str(spec.log_folder) == "logs" else ["-f", str(spec.log_folder)]
        newest = max(numbers, default=run.number)
        command += [] if run.number == newest else ["--exp-id", str(run.number)]
    flag = as_flag(spec.user_modules, spec.env_id)
    return f"{called_as('enjoy')} {shlex.join(command)}{flag}"


def _brief(value: object) -> str:
    """A setting as the header shows it; a whole map would fill the screen."""
    text = str(value)
    return text if len(text) <= _LONGEST_SETTING else f"{text[:_LONGEST_SETTING]}..."


@contextmanager
def writing_watched(console: Console, training: Training) -> Iterator[None]:
    """Write the page that plays the training afterwards, where one was asked for.

    One that fails is shown as far as it came: how a table diverges is worth a look.
    """
    try:
        yield
    except UserError:
        with suppress(UserError, OSError):
            _write_watched(console, training)
        raise
    _write_watched(console, training)


def _write_watched(console: Console, training: Training) -> None:
    path = training.spec.watch_learning
    if training.watch is None or path is None or not training.watch.has_begun:
        return
    from pipeline.signs_of_life import doing
    from report.learning_page import write_learning_page

    with doing(console, "writing the page that plays the training"):
        write_learning_page(training.spec, training.watch, path)
    console.print(f"learning {path}", highlight=False, soft_wrap=True)

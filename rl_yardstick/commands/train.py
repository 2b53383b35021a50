"""``train.py``: its flags, the training they ask for, and the output before and after it."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands.cli import (
    BUDGET,
    COUNT,
    INTERVAL,
    LOG_INTERVAL,
    SEED,
    VERBOSITY,
    OneLineParser,
    add_shared,
    assignments,
    called_as,
    check_device,
    check_tensorboard,
    command_line,
    exit_code,
    filled,
    go_on_unread,
    save_interval,
    whole_number,
)
from rl_yardstick.pipeline import loading_libraries
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.failures import exits_as_mistakes
from rl_yardstick.pipeline.stopping import StopRequest, stops_noticed

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from stable_baselines3.common.base_class import BaseAlgorithm

    from rl_yardstick.pipeline.callbacks import PullSummary
    from rl_yardstick.pipeline.preparation import Training
    from rl_yardstick.pipeline.runs import Run
    from rl_yardstick.pipeline.train_spec import TrainSpec
    from rl_yardstick.pipeline.training import Outcome

# --- flags ----------------------------------------------------------------------------------------

WATCHED = whole_number(1, besides={0: "those of the first 5,000 steps"})

# The flags for interrupted runs, by the names of their values: run folders do not record them.
RESUMING = ("resume", "resume_or_start", "save_state_every", "keep_state")

# Flags allowed beside --resume: those of output, states and imports, none of the training itself.
_BESIDE_RESUME = {"resume", "save_state_every", "keep_state", "log_folder", "gym_packages"}
_BESIDE_RESUME |= {"verbose", "progress", "list"}


EPILOG = """\
examples:
  python train.py --env Warehouse-v0 --algo ppo --engine auto
  python train.py --env FrozenLake-v1 --algo qlearning --n-episodes 5000 --seed 0
  python train.py --env CartPole-v1 --algo dqn -params learning_rate:lin_0.003 buffer_size:50000
  python train.py --env Warehouse-v0 --algo sarsa --env-kwargs shelf_reward:-1 slip:0.1
  python train.py --resume logs/ppo/Warehouse-v0_3
  python train.py --list
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags, with the names and meanings that rl_zoo3 gives them."""
    parser = OneLineParser(
        description="Train an agent and leave a run folder with its models, curves and settings.",
        epilog=EPILOG,
    )
    add = parser.add_argument
    add("--algo", default="ppo", help="agent (default: ppo; see --list)")
    add("--env", default="CartPole-v1", help="environment id (default: CartPole-v1; see --list)")
    add("--list", action="store_true", help="list agents and environments, and which fit which")

    group = parser.add_argument_group("budget and settings")
    add = group.add_argument
    add("-n", "--n-timesteps", type=BUDGET, default=-1, metavar="N", help="environment steps")
    add("--n-episodes", type=BUDGET, default=-1, metavar="N", help="episodes instead of steps")
    add("--seed", type=SEED, default=-1, help="seed of everything (default: a random one)")
    changed = "hyperparameters to change, e.g. learning_rate:0.01"
    add_shared(group, "--hyperparams", help=changed)
    add_shared(group, "--engine", "--conf-file", "--env-kwargs")
    add("--eval-env-kwargs", **assignments(), help="environment arguments for evaluation only")
    add_shared(group, "--gym-packages")
    add(
        *("-i", "--trained-agent"),
        default="",
        metavar="ZIP",
        help="train this agent (zip or run folder) for -n further steps, in a new run folder; its "
        "statistics, replay buffer, step counter and schedules continue; hyperparameters are those "
        "given here or in the file",
    )
    add("--vec-env", choices=["dummy", "subproc"], default="dummy", help="kind of VecEnv")
    add_shared(group, "--device", "--num-threads")

    group = parser.add_argument_group("evaluation and output")
    add = group.add_argument
    add("--eval-freq", type=INTERVAL, metavar="N", help="steps between evaluations; -1 for none")
    add(
        "--eval-episodes",
        type=COUNT,
        metavar="N",
        help="episodes of each evaluation, the final one too (default: as few as are precise "
        "enough, up to 20, at the end up to 100)",
    )
    n_envs = "environments to evaluate on (10)"
    add("--n-eval-envs", type=COUNT, default=10, metavar="N", help=n_envs)
    add("--save-freq", type=INTERVAL, default=-1, metavar="N", help="steps between checkpoints")
    add("--save-replay-buffer", action="store_true", help="save the replay buffer, if there is one")
    add_shared(group, "--log-folder", default="logs", help="folder of all runs (logs)")
    add("-uuid", "--uuid", action="store_true", help="add a unique id to the run folder's name")
    add("-tb", "--tensorboard-log", default="", metavar="DIR", help="write TensorBoard logs there")
    records = "episodes (PPO, A2C: rollouts) between log records; -2 for none"
    add("--log-interval", type=LOG_INTERVAL, default=-1, metavar="N", help=records)
    levels = "0 silent, 1 progress and summary (default), 2 the library's tables as well"
    add("--verbose", type=VERBOSITY, default=1, help=levels)
    add("-P", "--progress", action="store_true", help="a progress bar even without a terminal")
    compared = "compare values, advantages and gradients with the exact ones at each evaluation"
    add("--diagnose", action="store_true", help=compared)
    add(
        "--watch-learning",
        type=filled,
        metavar="FILE",
        help="write a page (.html) that plays the training: each update of a table, or a network's "
        "action in each state, at every evaluation",
    )
    watched = "first episodes of a table to play (default: the steps in which its policy improves)"
    add("--watch-episodes", type=WATCHED, default=0, metavar="N", help=watched)

    add = parser.add_argument_group("continuing an interrupted run").add_argument
    add(
        "--resume",
        nargs="?",
        const="",
        metavar="RUN",
        help="continue this run, or the newest unfinished one of --algo and --env, to the same "
        "result as without the interruption; budget, seed and settings are those of the run",
    )
    add(
        "--resume-or-start",
        action="store_true",
        help="continue the newest run with exactly these settings, begin one if there is none, and "
        "do nothing if it is finished: for scripts that a queue starts again",
    )
    add(
        "--save-state-every",
        type=save_interval,
        default="auto",
        metavar="N",
        help="how often to save the state from which --resume continues: 30s, 5m, 5000 (steps), "
        "never, or auto, which takes about 2%% of the time (default)",
    )
    add("--keep-state", action="store_true", help="keep the state of a finished run")
    return parser


# --- main -----------------------------------------------------------------------------------------


def main() -> int:
    """Parse the arguments and train, resume or list; return the exit code."""
    args = build_parser().parse_args()
    with stops_noticed() as stop, exits_as_mistakes():
        if args.list:
            from rl_yardstick.pipeline.user_modules import import_typed

            import_typed(args.gym_packages)
            print_lists()
            return 0
        if args.resume is not None:
            run, spec = _resumed(args)
            return _go_on(args, run, spec, stop)
        spec = train_spec(args)
        if args.resume_or_start:
            from rl_yardstick.pipeline.unfinished_runs import recorded_training, run_of_spec

            there = run_of_spec(spec, any_seed=args.seed < 0)
            if there is not None:
                return _go_on(args, there, recorded_training(there, spec.user_modules), stop)
        return _begin(args, spec, stop)


def _begin(args: argparse.Namespace, spec: TrainSpec, stop: StopRequest) -> int:
    from rl_yardstick.commands.terminal import TextConsole, print_refusal, say
    from rl_yardstick.pipeline.signs_of_life import doing

    go_on_unread()
    console = TextConsole(quiet=spec.verbose < 1, force_terminal=spec.progress or None)
    print_header(console, spec)
    # The called functions decide where they can be stopped; a stop between them would leave a run
    # folder without an owner.
    with stop.held():
        with doing(console, "loading the libraries") as activity, loading_libraries():
            with stop.waiting(0.0):
                from rl_yardstick.pipeline.preparation import prepare
                from rl_yardstick.pipeline.runs import at_work_on
                from rl_yardstick.pipeline.unfinished_runs import StateKeeping

            activity.now("making the environments and the agent")
            keeping = StateKeeping(args.save_state_every, stays=args.keep_state)
            recorded = {name: value for name, value in vars(args).items() if name not in RESUMING}
            training = prepare(spec, console, recorded, command_line(), keeping=keeping)
            print_engine(console, training)
        print_refusal(console, training.refusal)
        tell = partial(say, console, style="dim")
        with at_work_on(training.run, tell), telling_what_is_kept(training.run):
            return _carried_out(training, console, stop)


def _carried_out(training: Training, console: Console, stop: StopRequest) -> int:
    from rl_yardstick.pipeline.runs import INTERRUPTED
    from rl_yardstick.pipeline.training import carry_out

    with writing_watched(console, training):
        outcome = carry_out(training, partial(print_result, console, training))
    return exit_code(stop.number) if outcome.state == INTERRUPTED else 0


# --- continuing an interrupted run ----------------------------------------------------------------


def _resumed(args: argparse.Namespace) -> tuple[Run, TrainSpec]:
    """The run that ``--resume`` selects, and its spec."""
    parser = build_parser()
    for action in parser._actions:
        action.default = argparse.SUPPRESS  # so that only typed flags remain, also typed defaults
    typed = vars(parser.parse_args())
    allowed = _BESIDE_RESUME | (set() if args.resume else {"algo", "env"})
    for action in parser._actions:
        if action.dest in typed and action.dest not in allowed:
            flag = action.option_strings[-1]
            raise UserError(f"{flag} cannot be given with --resume: the run has its own")
    from rl_yardstick.pipeline.models.find import run_in
    from rl_yardstick.pipeline.unfinished_runs import newest_unfinished, recorded_training
    from rl_yardstick.pipeline.user_modules import import_typed

    path = Path(args.resume)
    if not args.resume:
        run = newest_unfinished(Path(args.log_folder), args.algo, args.env)
    elif path.is_dir():
        run = run_in(path)
    else:
        raise UserError(f"{path}: there is no such run folder")
    return run, recorded_training(run, import_typed(args.gym_packages))


def _go_on(args: argparse.Namespace, run: Run, spec: TrainSpec, stop: StopRequest) -> int:
    """Continue a run from its newest saved state; return the exit code."""
    from rl_yardstick.commands.terminal import TextConsole, say
    from rl_yardstick.pipeline.runs import at_work_on, check_left, remove_states
    from rl_yardstick.pipeline.signs_of_life import doing
    from rl_yardstick.pipeline.unfinished_runs import go_on, is_finished, tell_changes

    spec = replace(spec, verbose=args.verbose, progress=args.progress)
    go_on_unread()
    console = TextConsole(quiet=spec.verbose < 1, force_terminal=spec.progress or None)
    tell = partial(say, console, style="dim")
    if not is_finished(run):
        print_header(console, spec)
        check_left(run)
    with stop.held(), ExitStack() as lock:
        with stop.waiting(0.0):
            lock.enter_context(at_work_on(run, tell))
        if is_finished(run):
            if not args.keep_state:  # left by a process that was killed just before removing them
                remove_states(run.state_path)
            console.print(f"{run.path} is finished already", highlight=False)
            return 0
        with doing(console, "loading the libraries") as activity, loading_libraries():
            with stop.waiting(0.0):
                from rl_yardstick.pipeline.preparation import prepare
                from rl_yardstick.pipeline.unfinished_runs import StateKeeping

                activity.now("making the environments and the agent")
                tell_changes(run, spec, tell)
                keeping = StateKeeping(args.save_state_every, stays=args.keep_state)
                keeping = go_on(run, keeping, tell)
            page = spec.watch_learning
            if keeping.state is not None:
                tell(f"continuing from step {keeping.state.note['steps']:,}")
            else:
                if page is not None and not args.watch_learning and page.exists():
                    why = "nothing shows that this run wrote it"
                    tell(f"{page} is there already and stays: {why}")
                    spec = replace(spec, watch_learning=None)
                tell("no state was saved: the run begins again")
            training = prepare(spec, console, {}, command_line(), run, keeping)
        print_engine(console, training)
        return _carried_out(training, console, stop)


# --- from flags to a spec -------------------------------------------------------------------------


def train_spec(args: argparse.Namespace) -> TrainSpec:
    """The spec that the arguments ask for."""
    from secrets import randbelow

    from rl_yardstick.pipeline.agent_settings import check_algorithm, check_fit, resolved_spec
    from rl_yardstick.pipeline.environments import (
        check_env_id,
        map_name,
        with_logs_located,
        with_maps_read,
    )
    from rl_yardstick.pipeline.train_spec import TrainSpec
    from rl_yardstick.pipeline.user_modules import import_typed

    modules = import_typed(args.gym_packages, [args.env])
    check_algorithm(args.algo)
    check_env_id(args.env)
    check_tensorboard(args.tensorboard_log)
    check_device(args.device)
    raw, typed = _raw_hyperparams(args)
    of_map = map_name(args.env, raw)
    raw = with_logs_located(args.env, with_maps_read(args.env, raw))
    trained_agent = None
    if args.trained_agent:
        from rl_yardstick.pipeline.models.choose import agent_to_continue

        trained_agent = agent_to_continue(Path(args.trained_agent))
    # A flag with the name of a field sets that field.
    names = {key.name for key in fields(TrainSpec)} - {"hyperparams"}
    named = {name: getattr(args, name) for name in names if name in args}
    changed = {
        "env_id": args.env,
        "map_name": of_map,
        "seed": args.seed if args.seed >= 0 else randbelow(2**31),
        "log_folder": Path(args.log_folder),
        "tensorboard_log": Path(args.tensorboard_log) if args.tensorboard_log else None,
        "trained_agent": trained_agent,
        "gym_packages": tuple(module.name for module in modules),
        "user_modules": modules,
        "unique_id": args.uuid,
        "final_episodes": args.eval_episodes,
        "watch_learning": _page_path(args),
    }
    spec = resolved_spec(raw, origins=typed, **{**named, **changed})
    if spec.hyperparams.n_timesteps is None and spec.hyperparams.n_episodes is None:
        raise UserError("how long to train? give -n STEPS or --n-episodes EPISODES")
    check_fit(spec)
    return spec


def _page_path(args: argparse.Namespace) -> Path | None:
    """The path of the page for ``--watch-learning``, checked; None without the flag."""
    from tempfile import TemporaryFile

    if args.watch_learning is None:
        if args.watch_episodes:
            raise UserError("--watch-episodes says how much --watch-learning shows: give that too")
        return None
    path = Path(args.watch_learning)
    if path.suffix != ".html":
        raise UserError(f"--watch-learning writes a .html file, not {path.name!r}")
    if not path.absolute().parent.is_dir():
        raise UserError(f"--watch-learning: there is no folder {path.parent}")
    if path.is_dir():
        raise UserError(f"--watch-learning: {path} is a folder")
    try:
        TemporaryFile(dir=path.absolute().parent).close()
    except OSError as error:
        reason = f"nothing can be written in {path.parent}: {error.strerror}"
        raise UserError(f"--watch-learning: {reason}") from error
    return path


def _raw_hyperparams(args: argparse.Namespace) -> tuple[dict[str, Any], dict[str, str] | None]:
    """The file's entry with the changes of the command line, and notes on dropped settings."""
    from rl_yardstick.pipeline.agent_settings import training_follows, with_engine
    from rl_yardstick.pipeline.settings.hyperparams import NoEntryError, override, read_hyperparams
    from rl_yardstick.pipeline.settings.values import parse_assignments

    asked = parse_assignments(args.hyperparams, "--hyperparams")
    changes = with_engine(args.algo, asked, args.engine)
    kwargs = parse_assignments(args.env_kwargs, "--env-kwargs") or changes.get("env_kwargs")
    try:
        entry = read_hyperparams(args.algo, args.env, args.conf_file, kwargs)
    except NoEntryError:
        if not changes:
            raise
        entry = {}
    typed: dict[str, Any] = {"env_kwargs": changes.get("env_kwargs")}
    for key, given in (("env_kwargs", args.env_kwargs), ("eval_env_kwargs", args.eval_env_kwargs)):
        if given:
            named = parse_assignments(given, f"--{key.replace('_', '-')}")
            in_params = changes.get(key)
            named = {**(in_params if isinstance(in_params, dict) else {}), **named}
            typed[key], changes[key] = named, {**(entry.get(key) or {}), **named}
    for key, budget in (("n_timesteps", args.n_timesteps), ("n_episodes", args.n_episodes)):
        if budget > 0:
            changes[key] = budget
    return training_follows(override(entry, changes), {**changes, **typed})


# --- output ---------------------------------------------------------------------------------------


def print_header(console: Console, spec: TrainSpec) -> None:
    """Print the agent, the environment, the budget and the hyperparameters."""
    from rich.text import Text

    from rl_yardstick.pipeline.signs_of_life import in_lines

    budget = spec.hyperparams.n_timesteps or spec.hyperparams.n_episodes or 0
    unit = "steps" if spec.hyperparams.n_timesteps else "episodes"
    agent, environment = Text(spec.algo, "bold"), Text(spec.env_id, "bold")
    console.print(
        Text.assemble(agent, " on ", environment, f", seed {spec.seed}, {budget:,} {unit}")
    )
    origins = spec.origins or {}
    plain, explained = [], []
    for key, value in spec.saved_hyperparams.items():
        if key == "policy" and not _is_choice(spec.algo, str(value)):
            continue
        text = str(value)  # a whole map would fill the screen
        text = f"{key}={text if len(text) <= 200 else f'{text[:200]}...'}"
        where = "in training only" if key in ("train_env_kwargs", "train_env_wrapper") else ""
        notes = "; ".join(filter(None, (where, _schedule_in_words(value), origins.get(key))))
        if notes:
            explained.append(f"{text} ({notes})")
        else:
            plain.append(text)
    for line in ["  ".join(plain), *explained] if plain else explained:
        console.print(in_lines(console, line), style="dim", highlight=False)


def _is_choice(algo: str, policy: str) -> bool:
    """Whether an agent has other policies, too: our tables and bandits have one each."""
    from rl_yardstick.agents import ALGORITHMS

    is_ours = algo in ALGORITHMS and ALGORITHMS[algo].entry_point.startswith("rl_yardstick.agents.")
    return not is_ours or policy.startswith(("Mlp", "Cnn", "MultiInput"))


def _schedule_in_words(value: object) -> str:
    """A schedule such as ``exp_0.3_0.05`` in words; empty for any other value."""
    from rl_yardstick.pipeline.settings.values import parse_schedule

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
    """Print the engine of the training, and its expected time."""
    from rl_yardstick.commands.terminal import say, training_line
    from rl_yardstick.pipeline.preparation import engine_outlook
    from rl_yardstick.pipeline.signs_of_life import in_lines

    model, callback = training.model, training.callback
    line = training_line(engine_outlook(model, training.spec, [callback]), model, callback)
    if line:
        say(console, in_lines(console, f"engine  {line}"), style="dim")


def print_result(console: Console, training: Training, outcome: Outcome) -> None:
    """Print the results, what a failed agent does instead, and commands to type next."""
    print_outcome(console, outcome)
    if console.quiet:
        return
    from rl_yardstick.commands.terminal import say
    from rl_yardstick.pipeline.evaluation.advice import advice
    from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
    from rl_yardstick.pipeline.signs_of_life import in_lines

    spec, model, evaluator = training.spec, training.model, training.evaluation.evaluator
    if outcome.final is not None:
        found = advice(spec, model, evaluator, outcome.final, outcome.n_steps)
        if found is not None:
            more = "more     docs/not-learning.md"
            tried = [f"try      {found.try_first}"] if found.try_first else []
            for line in (f"instead  {found.instead}", *tried, more):
                say(console, in_lines(console, line))
    is_bandit = bool(training.eval_env.has_attr("n_arms"))
    other = other_agent(spec, model, is_bandit=is_bandit)
    has_model = isinstance(evaluator, ExactEvaluator)
    say(console, "")
    for label, command in next_commands(spec, outcome.run, other, has_model=has_model):
        say(console, f"{label:<9}{command}")  # however long, so that it can be copied


def print_outcome(console: Console, outcome: Outcome) -> None:
    """Print what was done, and below it the result."""
    from rich.table import Table

    from rl_yardstick.commands.terminal import (
        APART,
        describe_others,
        judged,
        print_rows,
        result_lines,
        say,
    )
    from rl_yardstick.pipeline.runs import FINISHED

    taken, final = outcome.taken.cpu_seconds, outcome.final
    speed = outcome.n_steps / max(taken, 1e-9)
    done = "trained" if outcome.state == FINISHED else "interrupted"
    text = f"{outcome.n_steps:,} steps in {taken:.1f} s of processor time ({speed:,.0f} steps/s)"
    rows = [(done, text)]
    if outcome.engine:
        rows.append(("engine", outcome.engine))
    if final is not None and final.others is not None:
        rows += [("beside", line) for line in describe_others(final.others)]
    if outcome.best_return is not None:
        yardstick = None if final is None else final.yardstick
        best = judged(outcome.best_return, yardstick, outcome.best_episodes)
        when = f"at step {outcome.best_timesteps:,}"
        rows.append(("best", APART.join([*best, when])))
    if final is not None:
        tests = f"{outcome.evaluating.cpu_seconds:.1f} s of processor time"
        share = outcome.evaluation_steps / max(outcome.n_steps, 1)
        played = f"{outcome.evaluation_steps:,} steps beside training ({share:.0%} of it)"
        how = played if outcome.evaluation_steps else "exact, without playing"
        rows.append(("tests", f"{how}; {tests}"))
    rows.append(("files", str(outcome.run.path)))
    table = Table.grid(padding=(0, 2))
    for row in rows:
        table.add_row(*row)
    print_rows(console, table)
    results = [] if outcome.pulls is None else [describe_pulls(outcome.pulls)]
    results += [] if final is None else result_lines(final)
    for line in [""] * bool(results) + results:
        say(console, line)


def describe_pulls(pulls: PullSummary) -> str:
    """The regret of a training in a few words."""
    from rl_yardstick.commands.terminal import APART, percent
    from rl_yardstick.pipeline.runs import LAST_PULLS

    if pulls.regret is not None and pulls.optimal is not None:
        last = min(LAST_PULLS, pulls.n_pulls)
        best = f"best arm in {percent(pulls.optimal)} of the last {last}"
        return f"regret {pulls.regret:,.2f} over {pulls.n_pulls:,} pulls{APART}{best}"
    if pulls.reward is None:
        return f"regret not known: none of {pulls.n_pulls:,} pulls is in the log"
    return (
        f"regret not known{APART}reward {pulls.reward:.4f} a pull over the {pulls.n_matched:,} "
        f"of {pulls.n_pulls:,} that are in the log"
    )


def next_commands(
    spec: TrainSpec, run: Run, other: str | None, *, has_model: bool
) -> list[tuple[str, str]]:
    """Labels and commands, for the working directory of the training."""
    from rl_yardstick.pipeline.runs import numbered_runs
    from rl_yardstick.pipeline.settings.hyperparams import entry_names
    from rl_yardstick.pipeline.user_modules import as_flag

    chosen: list[str] = []
    numbers = [number for number, _ in numbered_runs(run.path.parent, run.env_name)]
    if numbers.count(run.number) > 1:  # only their unique suffixes differ
        chosen.append(str(run.path))
    else:
        chosen += ["--algo", spec.algo, "--env", spec.env_id]
        chosen += [] if str(spec.log_folder) == "logs" else ["-f", str(spec.log_folder)]
        newest = max(numbers, default=run.number)
        chosen += [] if run.number == newest else ["--exp-id", str(run.number)]
    special = spec.hyperparams
    compared = ["--env", spec.env_id, "--algos", spec.algo, *filter(None, [other])]
    words = [f"{key}:{value}" for key, value in special.env_kwargs.items()]
    compared += ["--env-kwargs", *words] if words else []
    if not entry_names(spec.algo):  # no shipped settings say how long to train
        is_steps, budget = special.n_timesteps is not None, special.n_timesteps
        compared += ["-n", str(budget)] if is_steps else ["--n-episodes", str(special.n_episodes)]
    compared += ["--seeds", "10"]
    compared += ["--engine", "auto"] if special.algorithm.get("engine") == "auto" else []
    found = [("watch", "enjoy", chosen), ("explain", "explain", chosen)]
    found = [*found[: 1 + has_model], ("compare", "compare", compared)]
    flag = as_flag(spec.user_modules, spec.env_id)
    return [(label, f"{called_as(name)} {shlex.join(words)}{flag}") for label, name, words in found]


def other_agent(spec: TrainSpec, model: BaseAlgorithm, *, is_bandit: bool) -> str | None:
    """The first other agent that fits the environment, if possible one with settings for it."""
    from rl_yardstick.agents import ALGORITHMS, fitting_algorithms
    from rl_yardstick.pipeline.settings.hyperparams import entry_names

    fitting = fitting_algorithms(model.observation_space, model.action_space, is_bandit)
    entries = {name: ALGORITHMS[name] for name in fitting if name != spec.algo}
    others = [name for name, each in entries.items() if each.for_bandits is is_bandit]
    others = [name for name in others if entries[name].is_installed]
    shipped = (name for name in others if spec.env_id in entry_names(name))
    return next(shipped, others[0] if others else None)


@contextmanager
def telling_what_is_kept(run: Run) -> Iterator[None]:
    """Append to the error of a failed run which models its folder keeps."""
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


@contextmanager
def writing_watched(console: Console, training: Training) -> Iterator[None]:
    """Write the page that plays the training afterwards, if it was asked for.

    A failed training is shown up to its failure: it may show how a table diverges.
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
    from rl_yardstick.commands.terminal import say
    from rl_yardstick.pipeline.signs_of_life import doing
    from rl_yardstick.report.page.learning import write_learning_page

    with doing(console, "writing the page that plays the training"):
        words = write_learning_page(training.spec, training.watch, path)
    say(console, f"learning {path}: {words}")


# --- the lists ------------------------------------------------------------------------------------


def print_lists() -> None:
    """Print the agents, the environments with settings for some agent, and how hard these are."""
    import gymnasium as gym
    from rich.table import Table

    from rl_yardstick.agents import ALGORITHMS, fitting_algorithms
    from rl_yardstick.agents.registry import is_bandit
    from rl_yardstick.commands.terminal import table_console
    from rl_yardstick.envs.wrappers import has_masks
    from rl_yardstick.pipeline.environments import make_env
    from rl_yardstick.pipeline.settings.hyperparams import entry_names

    console = table_console(highlight=False)
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("agent (--algo)", style="bold", no_wrap=True)
    table.add_column("what it is")
    for name, entry in ALGORITHMS.items():
        missing = "" if entry.is_installed else f"  needs: {entry.install_command}"
        table.add_row(name, entry.summary + missing)
    console.print(table)
    console.print()
    tuned = {name: set(entry_names(name)) for name in ALGORITHMS}
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("environment (--env)", style="bold", no_wrap=True)
    table.add_column("agents with hyperparameters for it; also: those that take the default ones")
    for env_id in sorted(set().union(*tuned.values()) & set(gym.registry)):
        env = make_env(env_id, {})
        with_entry = [name for name in ALGORITHMS if env_id in tuned[name]]
        fitting = fitting_algorithms(
            env.observation_space, env.action_space, is_bandit(env), has_masks(env)
        )
        others = [name for name in fitting if name not in with_entry]
        env.close()
        also = "\nalso: " + " ".join(others) if others else ""
        table.add_row(env_id, " ".join(with_entry) + also)
    console.print(table)
    console.print()
    console.print(_hardness_table())
    console.print(
        "\nAny other environment registered with Gymnasium works where the spaces fit; "
        "--gym-packages imports modules that register more, and agents of your own."
    )


def _hardness_table() -> Table:
    """Measures of the difficulty of environments with known models, as in their docs."""
    from rich.table import Table

    from rl_yardstick import envs

    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("how hard it is", style="bold", no_wrap=True)
    heads = "states", "diameter", "effective horizon", "random actions to a reward"
    for head in heads:
        table.add_column(head, justify="right")
    stored = json.loads(Path(envs.__file__).with_name("hardness.json").read_text(encoding="utf-8"))
    for env_id, found in sorted(stored.items()):
        table.add_row(env_id, *(found[head] for head in heads))
    return table

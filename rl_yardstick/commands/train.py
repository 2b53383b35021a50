"""``train.py``: its flags, the training that they ask for, and its output."""

from __future__ import annotations

import argparse
import shlex
from contextlib import suppress
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
    filled,
    whole_number,
    with_engine,
)
from rl_yardstick.pipeline.errors import Stopped, UserError

if TYPE_CHECKING:
    from rich.console import Console

    from rl_yardstick.pipeline.callbacks import PullSummary
    from rl_yardstick.pipeline.run import Run
    from rl_yardstick.pipeline.spec import TrainSpec
    from rl_yardstick.pipeline.training import Training

WATCHED = whole_number(1, besides={0: "those of the first 5,000 steps"})
# Flags that may stand beside --resume: none of the training itself.
_BESIDE_RESUME = {"resume", "log_folder", "gym_packages", "verbose", "progress", "algo", "env"}

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
    further = "zip or run folder of an agent to train for -n further steps, in a new run folder"
    add("-i", "--trained-agent", default="", metavar="ZIP", help=further)
    add("--vec-env", choices=["dummy", "subproc"], default="dummy", help="kind of VecEnv")
    add_shared(group, "--device", "--num-threads")

    group = parser.add_argument_group("evaluation and output")
    add = group.add_argument
    add("--eval-freq", type=INTERVAL, metavar="N", help="steps between evaluations; -1 for none")
    adaptive = "of each evaluation (adaptive: at most 20, or 100 for the final one)"
    add("--eval-episodes", type=COUNT, metavar="N", help=f"episodes {adaptive}")
    n_envs = "environments to evaluate on (10)"
    add("--n-eval-envs", type=COUNT, default=10, metavar="N", help=n_envs)
    add("--save-freq", type=INTERVAL, default=-1, metavar="N", help="steps between checkpoints")
    add("--save-replay-buffer", action="store_true", help="save the replay buffer too")
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
    page = "write a page (.html) that plays the training: each update, or each evaluation"
    add("--watch-learning", type=filled, metavar="FILE", help=page)
    watched = "first episodes of a table to play (default: the steps in which its policy improves)"
    add("--watch-episodes", type=WATCHED, default=0, metavar="N", help=watched)

    add = parser.add_argument_group("resuming").add_argument
    resumed = "resume this run, or the newest unfinished one of --algo and --env, to the same bits"
    add("--resume", nargs="?", const="", metavar="RUN", help=resumed)
    started = "resume the newest run with these settings; start one if there is none, and do "
    started += "nothing if it is finished: for scripts that a queue starts again"
    add("--resume-or-start", action="store_true", help=started)
    return parser


def main() -> int:
    """Train, resume or list."""
    args = build_parser().parse_args()

    from rl_yardstick.pipeline.components import import_modules, split_id
    from rl_yardstick.pipeline.run import Run, Stop

    module, args.env = split_id(args.env)
    args.gym_packages = [*args.gym_packages, *filter(None, [module])]
    import_modules(args.gym_packages)
    if args.list:
        from rl_yardstick.commands.lists import print_lists

        print_lists()
        return 0

    from rl_yardstick.commands.terminal import TextConsole

    stop = Stop().listen()
    console = TextConsole(quiet=args.verbose < 1, force_terminal=args.progress or None)
    if args.resume is not None:
        check_alone(args)
        path = Path(args.resume) if args.resume else newest_unfinished(args)
        return carry_out(resumed_spec(path, args), Run(path, console, stop), args, resumes=True)
    spec = spec_from_flags(args)
    if args.resume_or_start and (found := run_of(spec, Path(args.log_folder), args.seed < 0)):
        run = Run(found, console, stop)
        if run.recorded().get("state") == "finished":
            console.print(f"{found} is finished already")
            return 0
        return carry_out(resumed_spec(found, args), run, args, resumes=True)
    from uuid import uuid4

    suffix = f"_{uuid4()}" if args.uuid else ""
    run = Run.claim(Path(args.log_folder), spec, suffix, console=console, stop=stop)
    return carry_out(spec, run, args, resumes=False)


def carry_out(spec: TrainSpec, run: Run, args: argparse.Namespace, resumes: bool) -> int:
    """Hold the folder, train, and print the result."""
    from rl_yardstick.commands.engines import engine_outlook, training_line
    from rl_yardstick.commands.terminal import say

    console = run.console

    def tell(parts: Training) -> None:
        outlook = engine_outlook(parts.agent, parts.spec, [parts.callback])
        if not console.quiet and (line := training_line(outlook, parts.agent, parts.callback)):
            say(console, f"engine   {line}", style="dim")

    with run:
        print_header(console, spec)
        if not resumes:
            run.begin(spec, {**vars(args), "seed": spec.seed}, command_line())
        try:
            with console.status("loading the libraries"):
                from rl_yardstick.pipeline.training import train
            outcome = train(spec, run, resumes, tell)
        except Stopped:
            if run.has_begun:
                console.print(f"stopped; resume with: {called_as('train')} --resume {run.path}")
            raise
        except UserError as error:
            raise UserError(f"{error}{what_is_kept(run)}") from error
        print_outcome(console, spec, run, outcome)
    return 0


def what_is_kept(run: Run) -> str:
    """The models in the folder of a failed run, in words."""
    if not run.has_begun:
        return ""
    best, n_checkpoints = run.best_model_path, len(run.checkpoints())
    kept = [best.name] if best.exists() else []
    kept += [f"{n_checkpoints:,} checkpoint{'s'[: n_checkpoints > 1]}"] if n_checkpoints else []
    return f"; {run.path} keeps {' and '.join(kept) or 'no model'}"


# --- from flags to a spec -------------------------------------------------------------------------


def spec_from_flags(args: argparse.Namespace) -> TrainSpec:
    """The spec that the flags and the hyperparameters ask for; torch is not imported."""
    from secrets import randbelow

    from rl_yardstick.pipeline.environments import (
        check_env_id,
        check_fit,
        map_name,
        with_files_read,
    )
    from rl_yardstick.pipeline.settings import check_agent, read_spec

    check_agent(args.algo)
    check_env_id(args.env)
    check_tensorboard(args.tensorboard_log)
    check_device(args.device)
    entry, origins = entry_from_flags(args)
    trained_agent = None
    if args.trained_agent:
        from rl_yardstick.pipeline.models import model_in, zip_data

        path = Path(args.trained_agent)
        path = model_in(path) if path.is_dir() else path
        zip_data(path)
        trained_agent = str(path.absolute())
    names = ["eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "save_replay_buffer"]
    names += ["log_interval", "vec_env", "device", "diagnose", "watch_episodes", "gym_packages"]
    spec = read_spec(
        args.algo,
        args.env,
        with_files_read(args.env, entry),
        seed=args.seed if args.seed >= 0 else randbelow(2**31),
        final_episodes=args.eval_episodes,
        n_threads=args.num_threads,
        trained_agent=trained_agent,
        tensorboard_log=args.tensorboard_log or None,
        library_log=args.verbose > 1,
        watch_learning=page_path(args),
        map_name=map_name(args.env, entry),
        origins=origins,
        **{name: getattr(args, name) for name in names},
    )
    check_fit(spec)
    return spec


def entry_from_flags(args: argparse.Namespace) -> tuple[dict[str, Any], dict[str, str]]:
    """The entry with the changes of the command line, and notes on dropped settings."""
    from rl_yardstick.pipeline.settings import (
        override,
        parse_assignments,
        read_entry,
        training_follows,
    )

    asked = parse_assignments(args.hyperparams, "-params")
    changes = with_engine(args.algo, asked, args.engine)
    for key, given in (("env_kwargs", args.env_kwargs), ("eval_env_kwargs", args.eval_env_kwargs)):
        if given:
            named = parse_assignments(given, f"--{key.replace('_', '-')}")
            changes[key] = {**(changes.get(key) or {}), **named}
    for key, budget in (("n_timesteps", args.n_timesteps), ("n_episodes", args.n_episodes)):
        if budget > 0:
            changes[key] = budget
    try:
        entry = read_entry(args.algo, args.env, args.conf_file, changes.get("env_kwargs"))
    except UserError:
        if not changes or args.conf_file:
            raise
        entry = {}
    typed = dict(changes)
    for key in ("env_kwargs", "eval_env_kwargs"):
        if changes.get(key):
            changes[key] = {**(entry.get(key) or {}), **changes[key]}
    return training_follows(override(entry, changes), typed)


def page_path(args: argparse.Namespace) -> str | None:
    """The path of the page for ``--watch-learning``, checked; None without the flag."""
    if args.watch_learning is None:
        if args.watch_episodes:
            raise UserError("--watch-episodes needs --watch-learning FILE")
        return None
    path = Path(args.watch_learning)
    if path.suffix != ".html" or path.is_dir():
        raise UserError(f"--watch-learning writes a .html file, not {path.name!r}")
    if not path.absolute().parent.is_dir():
        raise UserError(f"--watch-learning: there is no folder {path.parent}")
    return str(path.absolute())


# --- resuming -------------------------------------------------------------------------------------


def check_alone(args: argparse.Namespace) -> None:
    """Refuse flags of a training beside ``--resume``: the run has its own."""
    parser = build_parser()
    for action in parser._actions:
        action.default = argparse.SUPPRESS  # only typed flags remain, also typed defaults
    typed = set(vars(parser.parse_args()))
    allowed = _BESIDE_RESUME - ({"algo", "env"} if args.resume else set())
    for action in parser._actions:
        if action.dest in typed - allowed:
            flag = action.option_strings[-1]
            raise UserError(f"{flag} cannot be given with --resume: the run has its own")


def resumed_spec(path: Path, args: argparse.Namespace) -> TrainSpec:
    """The spec of an unfinished run, whose modules were typed."""
    from rl_yardstick.pipeline.components import check_typed
    from rl_yardstick.pipeline.run import resumable

    if not path.is_dir():
        raise UserError(f"{path}: there is no such run folder")
    spec = resumable(path)
    check_typed(spec.gym_packages, args.gym_packages, str(path))
    return spec.changed(gym_packages=args.gym_packages)


def newest_unfinished(args: argparse.Namespace) -> Path:
    """The newest run of ``--algo`` and ``--env`` that has not finished."""
    from rl_yardstick.pipeline.run import Run, numbered_runs

    name = args.env.replace("/", "-")
    for _, path in reversed(numbered_runs(Path(args.log_folder) / args.algo, name)):
        if Run(path).recorded().get("state") not in (None, "finished"):
            return path
    raise UserError(f"{args.log_folder} has no unfinished run of {args.algo} on {name}")


def run_of(spec: TrainSpec, log_folder: Path, any_seed: bool) -> Path | None:
    """The newest run with exactly these settings."""
    from rl_yardstick.pipeline.run import Run, numbered_runs

    for _, path in reversed(numbered_runs(log_folder / spec.algo, spec.env_name)):
        with suppress(UserError):
            found = Run(path).spec()
            if found == (spec.changed(seed=found.seed) if any_seed else spec):
                return path
    return None


# --- output ---------------------------------------------------------------------------------------


def print_header(console: Console, spec: TrainSpec) -> None:
    """Print the agent, the environment, the budget and the hyperparameters."""
    from rl_yardstick.commands.terminal import say

    unit = "steps" if spec.n_timesteps else "episodes"
    budget = spec.n_timesteps or spec.n_episodes or 0
    say(console, f"{spec.algo} on {spec.place}, seed {spec.seed}, {budget:,} {unit}", "bold")
    plain, explained = [], []
    for key, value in spec.hyperparams.items():
        if key == "policy" and not str(value).startswith(("Mlp", "Cnn", "MultiInput")):
            continue  # our tables and bandits have one each
        text = str(value)  # a whole map would fill the screen
        text = f"{key}={text if len(text) <= 200 else f'{text[:200]}...'}"
        where = "in training only" if key in ("train_env_kwargs", "train_env_wrapper") else ""
        notes = "; ".join(filter(None, (where, schedule_in_words(value), spec.origins.get(key))))
        if notes:
            explained.append(f"{text} ({notes})")
        else:
            plain.append(text)
    for line in ["  ".join(plain), *explained] if plain else explained:
        console.print(line, style="dim")


def schedule_in_words(value: object) -> str:
    """A schedule such as ``exp_0.3_0.05`` in words; empty for any other value."""
    if not (isinstance(value, str) and value.startswith(("lin_", "exp_"))):
        return ""
    kind, *numbers = value.split("_")
    try:
        start, end = [*map(float, numbers), 0.0][:2]
    except ValueError:  # the agent's constructor tells
        return ""
    how = "linearly" if kind == "lin" else "exponentially"
    return f"{'falls' if end < start else 'rises'} {how} from {start:g} to {end:g}"


def print_outcome(console: Console, spec: TrainSpec, run: Run, outcome: Training) -> None:
    """Print what was done, below it the result, and the commands to type next."""
    if console.quiet:
        return
    from rich.table import Table

    from rl_yardstick.commands.terminal import print_rows, result_lines, say

    table = Table.grid(padding=(0, 2))
    for row in rows_of(run, outcome):
        table.add_row(*row)
    print_rows(console, table)
    results = [] if outcome.pulled is None else [describe_pulls(outcome.pulled)]
    results += [] if outcome.final is None else result_lines(outcome.final)
    for line in [""] * bool(results) + results:
        say(console, line)
    if outcome.advice is not None:
        console.print(f"instead  {outcome.advice.instead}")
        if outcome.advice.try_first:
            console.print(f"try      {outcome.advice.try_first}")
        say(console, "more     docs/not-learning.md")
    say(console, "")
    for label, command in next_commands(spec, run, outcome):
        say(console, f"{label:<9}{command}")  # however long, so that it can be copied
    if outcome.watch is not None and spec.watch_learning is not None:
        from rl_yardstick.report.page.learning import write_learning_page

        with console.status("writing the page that plays the training"):
            words = write_learning_page(spec, outcome.watch, Path(spec.watch_learning))
        say(console, f"learning {spec.watch_learning}: {words}")


def rows_of(run: Run, outcome: Training) -> list[tuple[str, str]]:
    """What was done: labels and figures."""
    from rl_yardstick.commands.terminal import APART, describe_others, judged

    taken, final = outcome.progress.taken.cpu_seconds, outcome.final
    n_steps = outcome.agent.num_timesteps
    speed = n_steps / max(taken, 1e-9)
    text = f"{n_steps:,} steps in {taken:.1f} s of processor time ({speed:,.0f} steps/s)"
    rows = [("trained", text)]
    if outcome.engine:
        rows.append(("engine", outcome.engine))
    if final is not None and final.others is not None:
        rows += [("beside", line) for line in describe_others(final.others)]
    if outcome.evaluation.best is not None:
        yardstick = None if final is None else final.yardstick
        best = judged(outcome.evaluation.best, yardstick, outcome.evaluation.best_episodes)
        rows.append(("best", APART.join([*best, f"at step {outcome.evaluation.best_timesteps:,}"])))
    if final is not None:
        tests = f"{outcome.evaluation.taken.cpu_seconds:.1f} s of processor time"
        share = outcome.evaluation_steps / max(n_steps, 1)
        played = f"{outcome.evaluation_steps:,} steps beside training ({share:.0%} of it)"
        how = played if outcome.evaluation_steps else "exact, no episodes sampled"
        rows.append(("tests", f"{how}; {tests}"))
    return [*rows, ("files", str(run.path))]


def describe_pulls(pulls: PullSummary) -> str:
    """The regret of a training in a few words."""
    from rl_yardstick.commands.terminal import APART, percent
    from rl_yardstick.pipeline.run import LAST_PULLS

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


def next_commands(spec: TrainSpec, run: Run, outcome: Training) -> list[tuple[str, str]]:
    """Labels and commands, for the working directory of the training."""
    from rl_yardstick.pipeline.run import numbered_runs
    from rl_yardstick.pipeline.settings import entry_names

    newest = numbered_runs(run.path.parent, spec.env_name)[-1][1] == run.path
    chosen = ["--algo", spec.algo, "--env", spec.env_id] if newest else [str(run.path)]
    log_folder = run.path.parents[1]
    chosen += ["-f", str(log_folder)] if newest and str(log_folder) != "logs" else []
    compared = ["--env", spec.env_id, "--algos", spec.algo, *filter(None, [other_agent(spec)])]
    words = [f"{key}:{value}" for key, value in spec.env_kwargs.items()]
    compared += ["--env-kwargs", *words] if words else []
    if not entry_names(spec.algo):  # no shipped settings say how long to train
        budget = ["-n", spec.n_timesteps] if spec.n_timesteps else ["--n-episodes", spec.n_episodes]
        compared += map(str, budget)
    compared += ["--seeds", "10"]
    compared += ["--engine", "auto"] if spec.algorithm.get("engine") == "auto" else []
    found = [("watch", "enjoy", chosen), ("explain", "explain", chosen)]
    found = [*found[: 1 + outcome.can_be_explained], ("compare", "compare", compared)]
    more = ["--gym-packages", *spec.gym_packages] if spec.gym_packages else []
    return [(label, f"{called_as(name)} {shlex.join([*w, *more])}") for label, name, w in found]


def other_agent(spec: TrainSpec) -> str | None:
    """The first other agent that fits the environment, if possible one with settings for it."""
    from contextlib import closing

    from rl_yardstick.agents import ALGORITHMS, fitting_algorithms
    from rl_yardstick.agents.registry import is_bandit
    from rl_yardstick.pipeline.environments import make_single_env
    from rl_yardstick.pipeline.settings import entry_names

    with closing(make_single_env(spec)) as env:
        for_bandits = is_bandit(env)
        fitting = fitting_algorithms(env.observation_space, env.action_space, for_bandits)
    others = [name for name in fitting if name != spec.algo and ALGORITHMS[name].is_installed]
    others = [name for name in others if ALGORITHMS[name].for_bandits is for_bandits]
    shipped = (name for name in others if spec.env_id in entry_names(name))
    return next(shipped, others[0] if others else None)
